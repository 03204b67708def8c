"""Episodes of a rollout, each on the level that it began on, whichever rollout that was in."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase

from proposer_rl.curricula.batches import packed
from proposer_rl.settings import ArgumentError

LEVEL_ID = "level_id"
ENDS = ("done", "terminated", "truncated", "success")


class Segments:
    """Cuts rollouts of the same environments, one after another, into episodes.

    What of a rollout belongs to episodes that have not ended is kept for the next one.
    """

    def __init__(self) -> None:
        self._kept: TensorDictBase | None = None  # [n, L]
        self._left: TensorDictBase | None = None  # what is to be kept of the last rollout

    def ended(self, rollout: TensorDictBase) -> tuple[NDArray[np.int64], TensorDictBase]:
        """The episodes that end in a rollout.

        Args:
            rollout: [*B, T] with ``level_id``, a number for each level that was begun.

        Returns:
            Their levels' numbers [m], and a rollout [1, m, L] of whole episodes; what is behind the
            end of each is no step, as ``is_step`` says: it has no reward and no end.

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
        kept = self._kept
        if kept is not None and len(kept) != len(rows):
            raise ArgumentError(
                f"rollout: of {len(rows)} environments, but the last one was of {len(kept)}"
            )
        joined: Any = rows  # a checkpoint's tensors are on the CPU
        if kept is not None:
            joined = torch.cat([kept.to(rows[LEVEL_ID].device), rows], 1)
        known = 0 if kept is None else kept.shape[1]
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
        self._left = joined[:, int(unfinished.min()) :].clone() if len(ids) else None
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
        return ids[row, end].cpu().numpy(), episodes

    def keep(self) -> None:
        """Go on to the next rollout."""
        self._kept, self._left = self._left, None

    def state_dict(self) -> dict[str, Any]:
        """What is kept."""
        if self._kept is None:
            return {}
        return {"shape": list(self._kept.batch_size), "kept": packed(self._kept)}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on with it."""
        self._kept = self._left = None
        if state:
            self._kept = TensorDict.from_dict(dict(state["kept"]), batch_size=state["shape"])
