"""What a Proposer sees of Solvers: their return and their answers on levels of the target."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from proposer_rl.models import ActorCritic
from proposer_rl.streams import Streams

Levels = Any  # a tensordict or tensorclass, of which nothing but the batch size is known here

# Draws that many levels from a distribution.
SampleLevels = Callable[[int, torch.Generator], Levels]

# Mean "return" of K Solvers on each of the levels [E], as a tensordict [K, E]. An exact evaluator
# has no use for the generator.
Evaluate = Callable[[ActorCritic, Levels, torch.Generator], TensorDictBase]

# What such performance on levels [*B] counts for, float [*B].
Measure = Callable[[TensorDictBase], Tensor]

# What is seen of K Solvers on levels [C]: float [K, C, ...].
Probe = Callable[[ActorCritic, Levels], Tensor]


LEAST_SUCCESS = 1e-3
"""Below it, success hardly counts for :func:`log_success`."""


def episode_return(performance: TensorDictBase) -> Tensor:
    """The return on each level (the paper's measure)."""
    return performance["return"]


def log_success(performance: TensorDictBase) -> Tensor:
    """The logarithm of the probability of success on each level, not below that of 0.001.

    A beginner's return on the target hardly moves, whatever it trains on: from one success in five
    hundred to one in a hundred is a step of 0.008. Its logarithm moves by 1.6, and shows what was
    due to the training.
    """
    return (performance["success"] + LEAST_SUCCESS).log()


class SolverView:
    """Validation and probe levels, drawn anew for every cycle, and Solvers seen through them.

    Args:
        target: draws validation and probe levels.
        evaluate: the Solvers' performance on the validation levels.
        probe: their answers on the probe levels.
        measure: what counts of it; its mean over the levels is called the validation return.
        validation_levels: size E of the validation batch.
        probe_levels: number of probes C.
        device: where the levels live.

    Raises:
        ValueError: if a size is out of range.
    """

    def __init__(
        self,
        *,
        target: SampleLevels,
        evaluate: Evaluate,
        probe: Probe,
        measure: Measure = episode_return,
        validation_levels: int = 75,
        probe_levels: int = 16,
        device: torch.device | str | None = None,
    ) -> None:
        if validation_levels < 1 or probe_levels < 0:
            raise ValueError(
                "validation_levels must be at least 1 and probe_levels at least 0; got "
                f"{validation_levels}, {probe_levels}"
            )
        self.validation_levels = validation_levels
        self.probe_levels = probe_levels
        self.device = torch.device(device or "cpu")
        self._target = target
        self._evaluate = evaluate
        self._probe = probe
        self._measure = measure
        self.draw_levels(Streams(0))

    def draw_levels(self, streams: Streams) -> None:
        """Draw a cycle's levels."""
        self.streams = streams
        self.validation = self._draw(self.validation_levels, "validation")
        self.probes = self._draw(self.probe_levels, "probes")

    @torch.no_grad()
    def validation_return(self, solver: ActorCritic, *place: int) -> Tensor:
        """Mean over the validation levels of what is measured, float [K].

        Args:
            solver: K Solvers.
            place: what distinguishes this evaluation from others of the cycle, for an evaluator
                that draws episodes.
        """
        generator = self.streams.generator("evaluation", *place, device=self.device)
        performance = self._evaluate(solver, self.validation, generator)
        return self._measure(performance).mean(1)

    @torch.no_grad()
    def see(self, solver: ActorCritic) -> Tensor:
        """What the probe levels show of Solvers, float [K, C, ...]."""
        return self._probe(solver, self.probes)

    def observation(self, validation_return: Tensor, probes: Tensor, progress: float) -> TensorDict:
        """The Proposer's observation of K Solvers.

        Args:
            validation_return: float [K].
            probes: float [K, C, ...].
            progress: the part of the cycle's updates that is done, in [0, 1].

        Returns:
            ``probes``, ``validation_return`` float [K, 1] and ``progress`` float [K, 1].
        """
        entries = {
            "probes": probes,
            "validation_return": validation_return.unsqueeze(-1),
            "progress": torch.full_like(validation_return, progress).unsqueeze(-1),
        }
        return TensorDict(entries, validation_return.shape, device=self.device)

    def observe(self, solver: ActorCritic, progress: float, *place: int) -> TensorDict:
        """Look at K Solvers; see :meth:`observation`."""
        return self.observation(self.validation_return(solver, *place), self.see(solver), progress)

    def _draw(self, count: int, purpose: str) -> Levels:
        return self._target(count, self.streams.generator(purpose))
