"""Proposals of a Proposer that has learnt elsewhere."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from proposer_rl.curricula.base import Curriculum, Improvement
from proposer_rl.learning.ppo import PPO
from proposer_rl.meta.actions import Proposals
from proposer_rl.meta.view import SolverView
from proposer_rl.models import ActorCritic, draw
from proposer_rl.streams import Streams

OWN_ACTIONS = ("sample", "mode")


class FrozenProposer(Curriculum):
    """The Solver trains on a Proposer's proposals, and nothing else happens.

    Args:
        agent: the Proposer.
        view: what it sees of the Solver; new levels at every cycle.
        proposals: the levels that its actions stand for.
        episode_length: updates L of the episodes in which it has learnt, from which it knows how
            far a cycle has gone.
        updates_per_step: updates for which an action holds.
        own_action: the action for the Solver itself: a ``"sample"`` of the policy, or its
            ``"mode"``, without exploration.

    Raises:
        ValueError: for an unknown ``own_action``.
    """

    most_solvers = 1

    def __init__(
        self,
        agent: ActorCritic,
        view: SolverView,
        proposals: Proposals,
        *,
        episode_length: int,
        updates_per_step: int = 1,
        own_action: str = "sample",
    ) -> None:
        if own_action not in OWN_ACTIONS:
            raise ValueError(f"own_action must be one of {list(OWN_ACTIONS)}, got {own_action!r}")
        self.agent = agent
        self.view = view
        self.proposals = proposals
        self.episode_length = episode_length
        self.updates_per_step = updates_per_step
        self.own_action = own_action
        self._updates = 0  # of this cycle
        self._action: Tensor | None = None

    def improve(
        self, solver: PPO, streams: Sequence[Streams], pause: Callable[[], None] | None = None
    ) -> Improvement:
        """Look at the Solver through new levels."""
        (stream,) = streams
        self.view.draw_levels(stream)
        self._updates = 0
        return Improvement()

    @torch.no_grad()
    def propose(self, solver: PPO, streams: Sequence[Streams]) -> Any:
        """Levels [1, P] of the Proposer's policy, given what it sees of the Solver."""
        (stream,) = streams
        if self._updates % self.updates_per_step == 0:
            self._action = self._act(solver, stream)
        assert self._action is not None
        problems = solver.env.batch_size[1:].numel()
        levels, _ = self.proposals.levels(self._action, problems, [stream])
        return levels

    def observe(self, levels: Any, rollout: TensorDictBase) -> None:
        """Count the update."""
        self._updates += 1

    def state_dict(self) -> dict[str, Any]:
        """Where the cycle's levels come from, how far it is, and the action that holds."""
        state = {"streams": self.view.streams.address, "updates": self._updates}
        return state if self._action is None else {**state, "action": self._action}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on within a cycle."""
        self.view.draw_levels(Streams(*state["streams"]))
        self._updates = int(state["updates"])
        action = state.get("action")
        self._action = None if action is None else action.to(self.view.device)

    def _act(self, solver: PPO, stream: Streams) -> Tensor:
        progress = self._updates / self.episode_length
        # -1: an episode's number that no rollout of the copies has.
        state = self.view.observe(solver.agent, progress, -1, self._updates)
        distribution = self.agent.distribution(self.agent(state))
        if self.own_action == "mode":
            return distribution.mode
        generator = stream.generator("proposals", device=self.view.device)
        shape = (1, *distribution.batch_shape[1:], *distribution.event_shape)
        noise = torch.rand(shape, generator=generator, device=self.view.device)
        return draw(distribution, noise)


def load_agent(agent: ActorCritic, snapshot: TensorDictBase) -> None:
    """Put the weights of a :meth:`~proposer_rl.learning.ppo.PPO.snapshot` into an agent (in place).

    Raises:
        ValueError: if they belong to another network.
    """
    parameters = dict(agent.named_parameters())
    shapes = {name: parameter.shape for name, parameter in parameters.items()}
    if shapes != {name: snapshot[name, "value"].shape for name in snapshot.keys()}:
        raise ValueError("the Proposer belongs to another network: its parameters differ")
    for name, parameter in parameters.items():
        parameter.data.copy_(snapshot[name, "value"])
