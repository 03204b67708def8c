"""Episodes of a rollout, each on the level that it began on, whichever rollout that was in."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase

from proposer_rl.settings import ArgumentError

LEVEL_ID = "level_id"
ENDS = ("done", "terminated", "truncated", "success")


def ended(
    rollout: TensorDictBase, kept: TensorDictBase | None = None
) -> tuple[NDArray[np.int64], TensorDictBase, TensorDictBase]:
    """The episodes that end in a rollout, and what of it belongs to others.

    Args:
        rollout: [*B, T] with ``level_id``, a number for each level that was begun.
        kept: [n, L], of episodes that had not ended in the rollouts before it, of the same n
            environments; None before the first.

    Returns:
        Their levels' numbers [m]; a rollout [1, m, L] of whole episodes, in which what is behind
        the end of each is no step, as ``is_step`` says: it has no reward and no end; and what is to
        be kept for the next rollout.

    Raises:
        ArgumentError: if it does not say which levels it is of, or other environments'.
    """
    if LEVEL_ID not in rollout.keys():
        raise ArgumentError(
            "rollout: has no level_id, so that nothing shows on which levels its episodes "
            "began; put LevelTransform around the environment, or give outcome_of(rollout) "
            "where each row begins with a reset on its level"
        )
    rows = rollout.reshape(-1, rollout.batch_size[-1])  # [n, T]
    joined: Any = rows
    known = 0
    if kept is not None:
        if len(kept) != len(rows):
            raise ArgumentError(
                f"rollout: of {len(rows)} environments, but the last one was of {len(kept)}"
            )
        # A checkpoint's tensors are on the CPU.
        joined = torch.cat([kept.to(rows[LEVEL_ID].device), rows], 1)
        known = kept.shape[1]
    ids = joined[LEVEL_ID].reshape(joined.shape)
    done = joined["next", "done"].reshape(joined.shape)
    first = torch.ones_like(done)
    first[:, 1:] = done[:, :-1] | (ids[:, 1:] != ids[:, :-1])
    time = torch.arange(ids.shape[1], device=ids.device)
    begun = time.where(first, 0).cummax(1).values  # of the episode that a step belongs to
    row, end = done[:, known:].nonzero(as_tuple=True)
    end = end + known
    start = begun[row, end]
    unfinished = begun[:, -1].where(~done[:, -1], ids.shape[1])
    left = joined[:, int(unfinished.min()) :].clone()
    length = (end - start + 1).max() if len(end) else 0
    step = start.unsqueeze(1) + time[: int(length)]
    inside = (step <= end.unsqueeze(1)).unsqueeze(-1)  # [m, L, 1]
    episodes = joined[row.unsqueeze(1), step.clamp(max=ids.shape[1] - 1)].unsqueeze(0)
    after = episodes["next"]
    for name in set(ENDS) & set(after.keys()):
        after[name] = after[name] & inside
    after["reward"] = after["reward"] * inside
    episodes["is_step"] = inside.squeeze(-1).unsqueeze(0)
    episodes.names = [None, None, "time"]
    return ids[row, end].cpu().numpy(), episodes, left
