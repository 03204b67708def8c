"""Episodes of a rollout, each on the level that it began on, whichever rollout that was in."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase

from proposer_rl.settings import ArgumentError

LEVEL_ID = "level_id"
MASK = ("collector", "mask")  # of the steps that are some, where trajectories were split
ENDS = ("done", "terminated", "truncated", "success")


def ended(
    rollout: TensorDictBase, kept: TensorDictBase | None = None
) -> tuple[NDArray[np.int64], TensorDictBase, TensorDictBase]:
    """The episodes that end in a rollout, and what of it belongs to others.

    Args:
        rollout: [*B, T] with ``level_id``, a number for each level that was begun, by which
            parts of an episode find each other, in whichever rows they are.
        kept: steps [L] of episodes that had not ended in the rollouts before it; None before the
            first.

    Returns:
        Their levels' numbers [m]; a rollout [1, m, L] of whole episodes, in which what is behind
        the end of each is no step, as ``is_step`` says: it has no reward and no end; and what is to
        be kept for the next rollout.

    Raises:
        ArgumentError: if it does not say which levels it is of.
    """
    if LEVEL_ID not in rollout.keys():
        raise ArgumentError(
            "rollout: has no level_id, so that nothing shows on which levels its episodes "
            "began; put LevelTransform around the environment, or give outcome_of(rollout) "
            "where each row begins with a reset on its level"
        )
    steps: Any = rollout.flatten()
    if MASK in rollout.keys(True):  # rows are filled up to one length
        steps = steps[rollout[MASK].reshape(-1)]
    if kept is not None:
        # A checkpoint's tensors are on the CPU.
        steps = torch.cat([kept.to(steps[LEVEL_ID].device), steps])
    ids, done = (entry.reshape(-1) for entry in (steps[LEVEL_ID], steps["next", "done"]))
    order = ids.argsort(stable=True)
    ids, done = ids[order], done[order]
    first = torch.ones_like(done)
    first[1:] = done[:-1] | (ids[1:] != ids[:-1])
    time = torch.arange(len(ids), device=ids.device)
    begun = time.where(first, 0).cummax(0).values  # of the episode that a step belongs to
    end = done.nonzero().squeeze(-1)
    end = end[order[end].argsort()]  # row by row
    start = begun[end]
    left = steps[order[~torch.isin(begun, start)]]
    length = (end - start + 1).max() if len(end) else 0
    step = start.unsqueeze(1) + time[: int(length)]
    inside = (step <= end.unsqueeze(1)).unsqueeze(-1)  # [m, L, 1]
    episodes = steps[order[step.clamp(max=len(ids) - 1)]].unsqueeze(0)
    after = episodes["next"]
    for name in set(ENDS) & set(after.keys()):
        after[name] = after[name] & inside
    after["reward"] = after["reward"] * inside
    episodes["is_step"] = inside.squeeze(-1).unsqueeze(0)
    episodes.names = [None, None, "time"]
    return ids[end].cpu().numpy(), episodes, left
