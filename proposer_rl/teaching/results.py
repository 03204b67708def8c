"""Turns a loop's results, numbers or rollouts, into outcomes that curricula observe."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase

from proposer_rl.curricula import outcome_of
from proposer_rl.settings import ArgumentError
from proposer_rl.teaching.numbers import as_numbers

RESULTS = ("return", "success", "score", "episodes", "steps")
COUNTS = ("episodes", "steps")
MOST = 1e15  # of these, which float64 still counts one by one
BOUNDS = {"success": (0, 1), "episodes": (1, MOST), "steps": (0, MOST)}
LEVEL_ID = "level_id"
MASK = ("collector", "mask")  # of the steps that are some, where trajectories were split
ENDS = ("done", "terminated", "truncated", "success")


def as_outcome(results: Mapping[str, NDArray[np.float64]]) -> TensorDict:
    """Returns the outcome [m] that curricula observe, from results [m] by name.

    NaN is a result that the loop did not give: a count is then 1; another result that is missing
    for one level is left out for all.
    """
    outcome = {}
    for name, result in results.items():
        missing = np.isnan(result)
        if name in COUNTS:
            outcome[name] = torch.from_numpy(np.where(missing, 1, result).astype(np.int64))
        elif not missing.any():
            outcome[name] = torch.from_numpy(result.astype(np.float32))
    return TensorDict(outcome, outcome["return"].shape)


def by_name(outcome: Any) -> dict[str, Any]:
    """Returns the results of an outcome, or its rollout alone where it has one.

    Raises:
        ArgumentError: for a name that means nothing here.
    """
    names = [*outcome.keys()]
    if "rollout" in names:
        return {"rollout": outcome["rollout"]}
    if unknown := [name for name in names if name not in RESULTS]:
        raise ArgumentError(f"outcome.{unknown[0]}: unknown; there are: {', '.join(RESULTS)}")
    return {name: outcome[name] for name in names}


def as_result(name: str, value: Any, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Reads the results of a name, [n] or of one level; one count may stand for all.

    Raises:
        ArgumentError: naming the argument, see :func:`as_numbers`.
    """
    given, counts = "return_" if name == "return" else name, name in COUNTS
    spread = shape == (1,) or (counts and shape != ())
    return as_numbers(given, value, shape, *BOUNDS.get(name, ()), whole=counts, spread=spread)


def outcome_of_rollout(rollout: TensorDictBase, rule: Any) -> TensorDict:
    """Returns the outcome [n] of a rollout [n, T], without success where nothing says it.

    Args:
        rollout: with ``success`` in its ``next``, or without.
        rule: an entry or a function of ``next`` that then says it; None for none.
    """
    rollout, after = rollout.copy(), rollout["next"].copy()
    if "success" not in after.keys() and rule is not None:
        after["success"] = rule(after) if callable(rule) else after[rule]
    rollout["next"] = after
    outcome = outcome_of(rollout)
    return outcome if "success" in after.keys() else outcome.exclude("success")


def ended(
    rollout: TensorDictBase, kept: TensorDictBase | None = None
) -> tuple[NDArray[np.int64], TensorDictBase, TensorDictBase]:
    """Returns the episodes that end in a rollout, and the steps of those that do not.

    Args:
        rollout: [*B, T] with ``level_id``, a number for each level that was begun, by which
            parts of an episode find each other, in whichever rows they are.
        kept: steps [L] of episodes that had not ended in the rollouts before it; None before the
            first.

    Returns:
        Their levels' numbers [m]; a rollout [m, L] of whole episodes, in which what is behind
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
    steps: Any = rollout.contiguous().flatten()  # also where it is stacked lazily
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
    episodes = steps[order[step.clamp(max=len(ids) - 1)]]
    after = episodes["next"]
    for name in set(ENDS) & set(after.keys()):
        after[name] = after[name] & inside
    after["reward"] = after["reward"] * inside
    episodes["is_step"] = inside.squeeze(-1)
    episodes.names = [None, "time"]
    return ids[end].cpu().numpy(), episodes, left
