"""What a Proposer sees of Solvers: their performance and their answers on levels of the target."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from proposer_rl.meta.rewards import mean_log_success, mean_return
from proposer_rl.models import ActorCritic
from proposer_rl.streams import Streams
from proposer_rl.task import Task


class SolverView:
    """Validation and probe levels, drawn anew for every cycle, and Solvers seen through them.

    Args:
        task: whose target the levels come from, and which tells how Solvers do there.
        validation_levels: size E of the batch that performance is measured on.
        probe_levels: number of probes C.

    Raises:
        ValueError: if a size is out of range.
    """

    def __init__(self, task: Task, *, validation_levels: int, probe_levels: int) -> None:
        if validation_levels < 1 or not 0 <= probe_levels <= validation_levels:
            raise ValueError(
                f"probe_levels={probe_levels} must be at least 0 and at most validation_levels="
                f"{validation_levels}: the Proposer is shown no more than it is rewarded for"
            )
        self.task = task
        self.validation_levels = validation_levels
        self.probe_levels = probe_levels
        self.draw_levels(Streams(0))

    def draw_levels(self, streams: Streams) -> None:
        """Draw a cycle's levels."""
        self.streams = streams
        target = self.task.target
        self.validation = target.sample(self.validation_levels, streams.generator("validation"))
        self.probes = target.sample(self.probe_levels, streams.generator("probes"))

    @torch.no_grad()
    def performance(self, agent: ActorCritic, *place: int) -> TensorDictBase:
        """What K Solvers reach on the validation levels, a tensordict [K, E].

        The place distinguishes evaluations of a cycle, for a task that plays episodes.
        """
        generator = self.streams.generator("evaluation", *place)
        return self.task.performance(agent, self.validation, generator)

    @torch.no_grad()
    def probe(self, agent: ActorCritic) -> Tensor:
        """What the probe levels show of K Solvers, float [K, C, ...]."""
        return self.task.probe(agent, self.probes)

    def observation(
        self, performance: TensorDictBase, probes: Tensor, progress: float
    ) -> TensorDict:
        """The Proposer's observation of K Solvers.

        Args:
            performance: on the validation levels, [K, E].
            probes: float [K, C, ...].
            progress: the part of the meta-episode that is over, in [0, 1].

        Returns:
            ``probes``; ``return``, and ``log_success`` where the task tells success: their means
            over the validation levels; ``progress``; each of these float [K, 1].
        """
        numbers = {"return": mean_return(performance)}
        if "success" in performance.keys():
            numbers["log_success"] = mean_log_success(performance)
        numbers["progress"] = torch.full_like(numbers["return"], progress)
        told = {name: number.unsqueeze(-1) for name, number in numbers.items()}
        return TensorDict({"probes": probes, **told}, probes.shape[:1], device=self.task.device)

    def observe(self, agent: ActorCritic, progress: float, *place: int) -> TensorDict:
        """Look at K Solvers; see :meth:`observation`."""
        return self.observation(self.performance(agent, *place), self.probe(agent), progress)
