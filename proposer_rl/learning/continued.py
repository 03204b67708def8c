"""An environment whose episodes go on from one rollout to the next."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import Compose, EnvBase, TransformedEnv


class ContinuedEpisodes(TransformedEnv):
    """Hands out where its episodes stand when it is reset, after the first time.

    An episode begins where another has ended, on the level that is set by then. So whoever sets the
    levels need not know when that is; or is asked for them by ``next_levels``.

    Args:
        env: of batch [*B], which keeps a level until the next reset.

    Attributes:
        next_levels: called where episodes begin, with whose they are, bool [*B]: the levels [*B]
            that are set then. None where levels are set from outside.
    """

    def __init__(self, env: EnvBase) -> None:
        super().__init__(env, Compose(), auto_unwrap=False)
        self.next_levels: Callable[[Tensor], Any] | None = None
        self.begin_anew()

    @property
    def fresh(self) -> bool:
        """Whether all episodes begin with the next reset."""
        return self._standing is None

    def begin_anew(self) -> None:
        """Begin all episodes with the next reset."""
        self._standing: TensorDictBase | None = None

    def maybe_reset(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Begin episodes where others have ended."""
        ended = tensordict["done"].squeeze(-1)
        if self.next_levels is not None and bool(ended.any()):
            self.base_env.set_levels(self.next_levels(ended))
        standing = self.base_env.maybe_reset(tensordict)
        self._standing = standing.copy()
        return standing

    def stand(self, levels: Any, actions: Tensor, steps: Tensor) -> None:
        """Take up episodes on levels [*B] where other ones like them were left.

        An environment that does the same after the same actions then stands where that one did.

        Args:
            levels: that they are on.
            actions: the last ones of each, [*B, T, ...].
            steps: how many of them belong to its episode, int64 [*B].
        """
        longest = int(steps.max())
        self.base_env.set_levels(levels)
        state = self.base_env.reset()
        for left in range(longest, -1, -1):
            begins = steps == left
            if left < longest and bool(begins.any()):
                state = self.base_env.reset(state.set("_reset", begins.unsqueeze(-1)))
            if left:
                # Those that have not begun play as well: it does not matter where they are.
                state.set("action", actions.select(steps.ndim, -left))
                _, state = self.base_env.step_and_maybe_reset(state)
        self._standing = state.copy()

    def _reset(self, tensordict: TensorDictBase | None = None, **options: Any) -> TensorDictBase:
        if self._standing is None:
            if self.next_levels is not None:
                every = torch.ones(self.batch_size, dtype=torch.bool, device=self.device)
                self.base_env.set_levels(self.next_levels(every))
            self._standing = super()._reset(tensordict, **options)
        return self._standing.copy()
