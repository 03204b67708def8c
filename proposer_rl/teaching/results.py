"""Turns a training loop's results, numbers or rollouts, into outcomes for curricula."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase

from proposer_rl.curricula import outcome_of
from proposer_rl.curricula.contract import outcome_of_episodes
from proposer_rl.settings import refuse_unknown, within
from proposer_rl.teaching.numbers import as_numbers

RESULTS = ("return", "success", "score", "episodes", "steps")
COUNTS = ("episodes", "steps")
MOST = 1e15  # up to which float64 holds every whole number
BOUNDS = {"success": (0, 1), "episodes": (1, MOST), "steps": (0, MOST)}
LEVEL_ID = "level_id"
MASK = ("collector", "mask")  # where split_trajectories marks real steps
ENDS = ("done", "terminated", "truncated", "success")


def as_outcome(results: Mapping[str, NDArray[Any]]) -> TensorDict:
    """Returns the outcome [m] that curricula observe, from results [m] by name.

    NaN means that the loop gave no result: a count is then 1, and another result that one level
    lacks is left out for all. If all levels have a rollout, the outcome is that of the rollouts.
    """
    results = dict(results)
    rollouts = results.pop("rollout").tolist()
    if all(rollout is not None for rollout in rollouts):
        played = outcome_of_episodes(rollouts)
        return played.exclude("success") if np.isnan(results["success"]).any() else played
    outcome = {}
    for name, result in results.items():
        missing = np.isnan(result)
        if name in COUNTS:
            outcome[name] = torch.from_numpy(np.where(missing, 1, result).astype(np.int64))
        elif not missing.any():
            outcome[name] = torch.from_numpy(result.astype(np.float32))
    return TensorDict(outcome, outcome["return"].shape)


def results_of(outcome: Any, rule: Any) -> dict[str, Any]:
    """Returns the results of an outcome by name, or those of its rollout if it has one.

    Args:
        outcome: results by name.
        rule: as of :func:`results_of_rollout`.

    Raises:
        ArgumentError: for an unknown name.
    """
    names = [*outcome.keys()]
    if "rollout" in names:
        return results_of_rollout(outcome["rollout"], rule)
    with within("outcome"):
        refuse_unknown(names, RESULTS)
    return {name: outcome[name] for name in names}


def as_result(name: str, value: Any, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Checks results of a name, [n] or of a single level; one count may stand for all levels.

    Raises:
        ArgumentError: as of :func:`~proposer_rl.teaching.numbers.as_numbers`.
    """
    if name == "rollout":
        return value
    given, counts = "return_" if name == "return" else name, name in COUNTS
    spread = shape == (1,) or (counts and shape != ())
    return as_numbers(given, value, shape, *BOUNDS.get(name, ()), whole=counts, spread=spread)


def results_of_rollout(rollout: TensorDictBase, rule: Any) -> dict[str, Any]:
    """Returns return, rollout and perhaps success of each row of a rollout [n, T].

    Args:
        rollout: with ``success`` in its ``next``, or without.
        rule: an entry or a function of ``next`` that gives the success if there is no such entry;
            None for none.
    """
    rollout, after = rollout.copy(), rollout["next"].copy()
    if "success" not in after.keys() and rule is not None:
        after["success"] = rule(after) if callable(rule) else after[rule]
    rollout["next"] = after
    outcome = outcome_of(rollout)
    rows = np.empty(len(rollout), object)
    rows[:] = outcome["rollout"].unbind(0)
    names = ("return", "success") if "success" in after.keys() else ("return",)
    return {**{name: outcome[name] for name in names}, "rollout": rows}


def ended(
    rollout: TensorDictBase, kept: TensorDictBase | None = None
) -> tuple[NDArray[np.int64], TensorDictBase, TensorDictBase]:
    """Returns the episodes that end in a rollout, and the steps of the other episodes.

    Args:
        rollout: [*B, T] with ``level_id``, the ticket of each step's level, by which the parts of
            an episode are put together from whichever rows they are in.
        kept: steps [L] of episodes that had not ended in earlier rollouts; None before the first.

    Returns:
        The tickets [m] of the episodes that end; a rollout [m, L] of these, padded with steps that
        have no reward and no end, and where ``is_step`` is false; and the steps to keep for the
        next rollout.
    """
    steps: Any = rollout.contiguous().flatten()  # contiguous, as it may be stacked lazily
    if MASK in rollout.keys(True):  # rows are padded to one length
        steps = steps[rollout[MASK].reshape(-1)]
    if kept is not None:
        # Loaded from a checkpoint, they are on the CPU.
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
