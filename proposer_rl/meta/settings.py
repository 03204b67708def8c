"""The settings of a Proposer and of its meta-environment."""

from __future__ import annotations

from dataclasses import field
from typing import Annotated, Literal

from annotated_types import Ge, Gt

from proposer_rl.learning import LearningSettings
from proposer_rl.settings import BY_KIND, settings


@settings
class MixtureSettings:
    """An action is a mixture of bins, from which the whole batch is drawn.

    Attributes:
        spread: standard deviation of the first policy.
    """

    kind: Literal["mixture"] = "mixture"
    spread: Annotated[float, Gt(0)] = 1.5


@settings
class ProblemSettings:
    """An action is the bin of every level, each drawn by itself (the paper's Proposer).

    Attributes:
        ratio: PPO's ratio over the P draws together, or for each draw.
        bands: frequencies of the problem index's Fourier encoding.
    """

    kind: Literal["problems"] = "problems"
    ratio: Literal["joint", "per_problem"] = "per_problem"
    bands: Annotated[int, Ge(1)] = 16


@settings
class ProposerSettings:
    """The Proposer and its meta-environment; not the paper's, but what was measured to learn.

    Attributes:
        rollouts: copies K of the Solver that are trained side by side.
        meta_episode_length: updates L of a meta-episode.
        action_repeat: updates for which an action holds; divides L.
        validation_levels: size E of the batch that the gain is measured on.
        probe_levels: number C of target levels through which the Solver is seen; at most E.
        observes: what is seen beside the probes.
        action: what an action means.
        own_action: what the Solver itself trains on: a sample of the policy or its mode.
        advance: what becomes of the Solver after a meta-episode: it trains by itself, or becomes
            the best copy, or a random one.
        advantage: against the mean of the other copies, or by a critic.
        context, hidden: widths of the network.
        ppo: PPO's numbers; the horizon is the number of actions of a meta-episode.
    """

    rollouts: Annotated[int, Ge(1)] = 16
    meta_episode_length: Annotated[int, Ge(1)] = 50
    action_repeat: Annotated[int, Ge(1)] = 50
    validation_levels: Annotated[int, Ge(1)] = 512
    probe_levels: Annotated[int, Ge(0)] = 16
    observes: list[Literal["return", "log_success", "progress"]] = field(
        default_factory=lambda: ["log_success", "progress"]
    )
    action: Annotated[MixtureSettings | ProblemSettings, BY_KIND] = MixtureSettings()
    own_action: Literal["sample", "mode"] = "mode"
    advance: Literal["train", "best", "random"] = "train"
    advantage: Literal["leave_one_out", "gae"] = "leave_one_out"
    context: Annotated[int, Ge(1)] = 128
    hidden: Annotated[int, Ge(1)] = 128
    ppo: LearningSettings = LearningSettings(updates=3, epochs=16, gamma=1.0)
