"""The Proposer as a curriculum: it learns in the meta-environment, then proposes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from proposer_rl.curricula.base import Advance, Improvement
from proposer_rl.curricula.frozen_proposer import FrozenProposer
from proposer_rl.learning.divergence import located
from proposer_rl.learning.ppo import PPO
from proposer_rl.meta.copies import Copies, CopiesHere
from proposer_rl.meta.env import SolverTrainingEnv
from proposer_rl.streams import Streams

ADVANCES = ("train", "best", "random")


class ProposerCurriculum(FrozenProposer):
    """Proposals of an agent that is trained on what they do to copies of the Solver.

    Before each cycle K copies of the Solver go through one episode of the meta-environment; the
    Proposer's PPO learns from them; then the Solver itself trains on the Proposer's proposals.

    Args:
        proposer: PPO whose environment is a :class:`~proposer_rl.meta.env.SolverTrainingEnv` and
            whose horizon is the number of steps of that environment's episodes.
        own_action: what is proposed to the Solver itself; see :class:`FrozenProposer`.
        copies: where the copies are rolled out; None for the Proposer's own environment, in this
            process.
        advance: ``"train"``: the Solver trains on new proposals; ``"best"`` or ``"random"``: it
            becomes the copy with the greatest total gain, or any, with its optimiser.
        table: arranges counts of the choices, int64 [N], for the record.

    Raises:
        ValueError: for an unknown ``advance`` or ``own_action``, or a horizon other than the
            episode's.
    """

    uses_workers = True

    def __init__(
        self,
        proposer: PPO,
        *,
        copies: Copies | None = None,
        own_action: str = "sample",
        advance: str = "train",
        table: Callable[[Tensor], Tensor] | None = None,
    ) -> None:
        env = proposer.env
        if not isinstance(env, SolverTrainingEnv):
            raise ValueError("the Proposer's environment must be a SolverTrainingEnv")
        if advance not in ADVANCES:
            raise ValueError(f"advance must be one of {list(ADVANCES)}, got {advance!r}")
        if proposer.settings.horizon != env.steps:
            raise ValueError(
                f"the Proposer's horizon {proposer.settings.horizon} must be the "
                f"meta-environment's number of steps, {env.steps}"
            )
        super().__init__(
            proposer.agent,
            env.view,
            env.proposals,
            episode_length=env.episode_length,
            updates_per_step=env.updates_per_step,
            own_action=own_action,
        )
        self.proposer = proposer
        self.env = env
        self.copies = copies or CopiesHere(proposer)
        self.advance = advance
        self._table = table or (lambda counts: counts)
        self._begun: dict[str, Any] | None = None

    def improve(
        self, solver: PPO, streams: Sequence[Streams], pause: Callable[[], None] | None = None
    ) -> Improvement:
        """Roll K copies of the Solver out and train the Proposer on their gains."""
        (stream,) = streams
        env = self.env
        self._updates = 0
        begun, self._begun = self._begun, None
        rollout = self.copies.roll_out(solver.snapshot()[0], stream, pause, begun)
        with located("the Proposer"):
            training = self.proposer.optimise(rollout)
            self.proposer.check()
        gains = total_gain(rollout)
        inner = env.solvers
        frames = inner.env.batch_size.numel() * inner.settings.horizon * env.episode_length
        advance = self._advance(solver, gains, stream)
        return Improvement(self._metrics(rollout, gains, training), frames, advance)

    def frozen(self) -> FrozenProposer:
        """The Proposer as it is, proposing without learning; it shares network and view."""
        return FrozenProposer(
            self.agent,
            self.view,
            self.proposals,
            episode_length=self.episode_length,
            updates_per_step=self.updates_per_step,
            own_action=self.own_action,
        )

    def state_dict(self) -> dict[str, Any]:
        """That of the cycle, with the Proposer's weights and optimiser, and a begun episode."""
        return {
            **super().state_dict(),
            "proposer": self.proposer.snapshot().to_dict(),
            "episode": self.copies.episode(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Put the Proposer and the cycle back."""
        super().load_state_dict(state)
        self.proposer.restore(TensorDict(state["proposer"], batch_size=[]))
        self._begun = state["episode"]

    def close(self) -> None:
        """Let go of the copies that are elsewhere."""
        self.copies.close()

    def _advance(self, solver: PPO, gains: Tensor, stream: Streams) -> Advance | None:
        if self.advance == "train":
            return None
        copies = gains.shape[0]
        if self.advance == "best":
            chosen = int(gains.argmax())
        else:
            generator = stream.generator("advance")
            chosen = int(torch.randint(copies, (), generator=generator))
        trained = self.copies.trained(chosen)
        solver.restore(trained.solver)
        return Advance(self.env.episode_length, trained.levels, trained.update)

    def _metrics(
        self, rollout: TensorDictBase, gains: Tensor, training: TensorDict
    ) -> dict[str, Any]:
        proposed = rollout["next", "proposed"].sum((0, 1))
        return {
            "total_gain": gains.tolist(),
            "gain_sd": float(gains.std(correction=0)),
            "gain_explained": explained_share(rollout["action"], gains),
            "total_reward": rollout["next", "reward"].sum((-2, -1)).tolist(),
            "return_before": float(rollout["validation_return"][0, 0]),
            **{key: float(value) for key, value in training.items()},
            "histogram": self._table(proposed).tolist(),
        }


def total_gain(rollout: TensorDictBase) -> Tensor:
    """Return on the validation levels after the episode minus before it, [K] from [K, T]."""
    after = rollout["next", "validation_return"][:, -1, 0]
    return after - rollout["validation_return"][:, 0, 0]


def explained_share(action: Tensor, gains: Tensor) -> float | None:
    """Share of the variance of total gains that a linear function of the actions explains.

    A hint, for nothing, of how much of the reward a Proposer can learn from: with adjustment for
    the number of coefficients it is 0 on average where the actions do not matter, and at most 1.
    ``proposer_rl.meta.signal`` measures the same without supposing linearity.

    Args:
        action: [K, T, D]; the mean over the T steps counts.
        gains: float [K].

    Returns:
        The adjusted coefficient of determination; None where actions are no numbers, or too many
        for K copies to tell.
    """
    if not action.is_floating_point():
        return None
    copies, directions = action.shape[0], action.shape[-1]
    spare = copies - 1 - directions
    if spare < 1 or float(gains.var()) == 0:
        return None
    actions, gains = action.mean(1).cpu().double(), gains.cpu().double()
    design = torch.cat([torch.ones(copies, 1, dtype=torch.double), actions], 1)
    fitted = design @ torch.linalg.lstsq(design, gains[:, None]).solution
    residual = (gains - fitted[:, 0]).square().sum() / spare
    return float(1 - residual / gains.var())
