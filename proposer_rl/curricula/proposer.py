"""The Proposer as a curriculum: it learns in the meta-environment, then proposes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from proposer_rl.curricula.base import Advance, Curriculum, Improvement
from proposer_rl.meta_env import SolverTrainingEnv
from proposer_rl.models import draw
from proposer_rl.ppo import PPO, Update
from proposer_rl.streams import Streams

ADVANCES = ("train", "best", "random")


class ProposerCurriculum(Curriculum):
    """Proposals of an agent that is trained on what they do to copies of the Solver.

    Before each cycle K copies of the Solver go through one episode of the meta-environment; the
    Proposer's PPO learns from them; then the Solver itself trains on the Proposer's proposals.

    Args:
        proposer: PPO whose environment is a :class:`~proposer_rl.meta_env.SolverTrainingEnv` and
            whose horizon is that environment's episode length.
        advance: ``"train"``: the Solver trains on new proposals; ``"best"`` or ``"random"``: it
            becomes the copy with the greatest total gain, or any, with its optimiser.
        histogram: counts of an action's choices, for the record: int64 [*, P] to nested lists.

    Raises:
        ValueError: for an unknown ``advance``, or a horizon other than the episode.
    """

    def __init__(
        self,
        proposer: PPO,
        *,
        advance: str = "train",
        histogram: Callable[[Tensor], Tensor] | None = None,
    ) -> None:
        env = proposer.env
        if not isinstance(env, SolverTrainingEnv):
            raise ValueError("the Proposer's environment must be a SolverTrainingEnv")
        if advance not in ADVANCES:
            raise ValueError(f"advance must be one of {list(ADVANCES)}, got {advance!r}")
        if proposer.settings.horizon != env.episode_length:
            raise ValueError(
                f"the Proposer's horizon {proposer.settings.horizon} must be the "
                f"meta-environment's episode length {env.episode_length}"
            )
        self.proposer = proposer
        self.env = env
        self.advance = advance
        self._histogram = histogram

    def improve(self, solver: PPO, streams: Sequence[Streams]) -> Improvement:
        """Roll K copies of the Solver out and train the Proposer on their gains."""
        (stream,) = streams
        env = self.env
        env.fork(solver.snapshot()[0], stream)
        rollout = self.proposer.collect(
            [
                stream.generator("proposals", copy, device=env.device)
                for copy in range(env.batch_size[0])
            ]
        )
        training = self.proposer.optimise(rollout)
        gains = total_gain(rollout)
        inner = env.solvers
        frames = inner.env.batch_size.numel() * inner.settings.horizon * env.episode_length
        advance = self._advance(solver, gains, stream)
        return Improvement(self._metrics(rollout, gains, training), frames, advance)

    @torch.no_grad()
    def propose(self, solver: PPO, streams: Sequence[Streams]) -> Any:
        """Levels [1, P] of the Proposer's policy, given its probes of the Solver."""
        (stream,) = streams
        agent = self.proposer.agent
        probes = self.env.see(solver.agent)  # [1, C, ...]
        state = TensorDict({"probes": probes}, [1], device=probes.device)
        distribution = agent.distribution(agent(state))
        noise_shape = (1, *self.env.action_spec.shape[1:])
        generator = stream.generator("proposals", device=self.env.device)
        noise = torch.rand(noise_shape, generator=generator, device=self.env.device)
        return self.env.generate(draw(distribution, noise), [stream.generator("levels")])

    def state_dict(self) -> dict[str, Any]:
        """The Proposer's weights and optimiser, and where the cycle's probe levels come from."""
        return {
            "proposer": self.proposer.snapshot().to_dict(),
            "streams": self.env.streams.address,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Put the Proposer and the cycle's probe levels back."""
        saved = TensorDict(state["proposer"], batch_size=[])
        self.proposer.restore(saved)
        self.env.draw_levels(Streams(*state["streams"]))

    def _advance(self, solver: PPO, gains: Tensor, stream: Streams) -> Advance | None:
        if self.advance == "train":
            return None
        copies = gains.shape[0]
        if self.advance == "best":
            chosen = int(gains.argmax())
        else:
            generator = stream.generator("advance")
            chosen = int(torch.randint(copies, (), generator=generator))
        solver.restore(self.env.solvers.snapshot()[[chosen]])
        levels, (rollout, metrics) = self.env.last_training
        own = Update(rollout[[chosen]], metrics)
        return Advance(self.env.episode_length, levels[[chosen]], own)

    def _metrics(
        self, rollout: TensorDictBase, gains: Tensor, training: TensorDict
    ) -> dict[str, Any]:
        metrics: dict[str, Any] = {
            "total_gain": gains.tolist(),
            "total_reward": rollout["next", "reward"].sum((-2, -1)).tolist(),
            "return_before": float(rollout["validation_return"][0, 0]),
            **{key: float(value) for key, value in training.items()},
        }
        if self._histogram is not None:
            metrics["histogram"] = self._histogram(rollout["action"]).tolist()
        return metrics


def total_gain(rollout: TensorDictBase) -> Tensor:
    """Return on the validation levels after the episode minus before it, [K] from [K, L]."""
    after = rollout["next", "validation_return"][:, -1, 0]
    return after - rollout["validation_return"][:, 0, 0]
