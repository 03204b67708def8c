"""Every curriculum, small and on mazes of seconds."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch

from proposer_rl import curricula as c
from proposer_rl import models
from proposer_rl.curricula import Curriculum, ReplayCurriculum, ReplayRule, Scorer
from proposer_rl.learning import PPOSettings
from proposer_rl.meta.assembly import ProposerSettings
from proposer_rl.meta.rewards import log_success_gain
from proposer_rl.methods import Components, proposer
from proposer_rl.streams import Streams
from tests.curricula.living import TASK

Make = Callable[[], Curriculum]
SPACE, TARGET, P = TASK.space, TASK.target, TASK.batch_size
SMALL = {"capacity": 16, "fill": 0.5, "replay_probability": 0.6}
SETTINGS = PPOSettings(horizon=1, learning_rate=3e-3, epochs=2)


def replay(
    score: str = "positive_value_loss",
    source: Any = "episodes",
    *,
    rule: ReplayRule | None = None,
    rollouts: int = 1,
    **options: Any,
) -> ReplayCurriculum:
    scorer = Scorer(score, source, rollouts)
    return ReplayCurriculum(SPACE, scorer, rule, edit=TASK.edit, **{**SMALL, **options})


def ncc() -> ReplayCurriculum:
    rule = ReplayRule(prioritization="softmax", temperature=0.05, staleness=0.0)
    return replay("learnability", "exact", rule=rule, renew=True)


def selection(source: Any = "exact", rollouts: int = 2, **options: Any) -> c.SelectionCurriculum:
    numbers = {"candidates": 16, "keep": 6, "every": 3, "new": 0.5, **options}
    return c.SelectionCurriculum(SPACE, Scorer("learnability", source, rollouts), **numbers)


def problem_agent() -> models.ActorCritic:
    torch.manual_seed(0)
    head = models.ProblemHead(8, P, SPACE.size, hidden=16, bands=4)
    network = models.ProposerNetwork(head, TASK.probe_encoder(8), context=8, hidden=8)
    return models.proposer_actor_critic(network, models.categorical)


def paired(streams: Streams | None = None) -> c.PairedProposer:
    antagonist = TASK.learner([streams or Streams(0, "antagonist")])
    return c.PairedProposer(
        SPACE, TARGET, problem_agent(), SETTINGS, task=TASK, antagonist=antagonist, probe_levels=2
    )


def first_order_proposer() -> c.FirstOrderProposer:
    numbers = {"probe_levels": 2, "target_levels": 3, "step": 1.0, "measure": "log_success"}
    return c.FirstOrderProposer(SPACE, TARGET, problem_agent(), SETTINGS, **numbers)


def learnt() -> c.ProposerCurriculum:
    """The paper's, in small."""
    settings = ProposerSettings(
        rollouts=2, meta_episode_length=2, action_repeat=1, validation_levels=4, probe_levels=2
    )
    return proposer(Components(TASK, settings, 0), reward=log_success_gain)


def frozen() -> c.ProposerCurriculum:
    """Without a trainer."""
    learning = learnt()
    return c.ProposerCurriculum(
        learning.agent,
        learning.view,
        learning.actions,
        meta_episode_length=2,
        action_repeat=2,
        own_action="sample",
    )


def filtered(curriculum: Curriculum, source: Any = "exact", times: int = 3) -> c.Filtered:
    return c.Filtered(curriculum, Scorer("learnability", source, 2), times=times, temperature=0.05)


def modelled(curriculum: Curriculum) -> c.Modelled:
    return c.Modelled(curriculum, TASK.features, half_life=2.0)


MADE: dict[str, Make] = {
    "uniform": lambda: c.SamplingCurriculum(SPACE),
    "filtered": lambda: filtered(c.SamplingCurriculum(SPACE)),
    "filtered from episodes": lambda: filtered(c.SamplingCurriculum(SPACE), "episodes"),
    "plr": lambda: replay(train_on_new=True),
    "robust": lambda: replay(synchronous=False),
    "synchronous": replay,
    "accel": lambda: replay(edits=3),
    "easy": lambda: replay(edits=3, parents="easy"),
    "max_mc": lambda: replay("max_mc"),
    "regret": lambda: replay("regret", "exact"),
    "plr of regret": lambda: replay("regret", "exact", train_on_new=True),
    "plr of regret, renewed": lambda: replay("regret", "exact", train_on_new=True, renew=True),
    "ncc": ncc,
    "regret, edited": lambda: replay("regret", "exact", edits=2),
    "gradients": lambda: replay("gradient_norm", "exact"),
    "policy gradients": lambda: replay("gradient_norm"),
    "sfl": selection,
    "sfl from episodes": lambda: selection("episodes"),
    "progress": lambda: c.LearningProgressCurriculum(SPACE, probes=2, every=2),
    "progress of episodes": lambda: c.LearningProgressCurriculum(SPACE, source="episodes", every=2),
    "alp_gmm": lambda: c.MixtureCurriculum(SPACE, warmup=8, refit=6, components=3),
    "adr": lambda: c.BoundsCurriculum(SPACE, boundary=0.9, episodes=3, lower=0.0, upper=0.1),
    "terrain_levels": lambda: c.RowsCurriculum(SPACE, measure="return", lower=0.0, upper=0.1),
    "spdl": lambda: c.SelfPacedCurriculum(
        SPACE, TARGET, TASK.target_shares, delta=0.01, episodes=6, measure="return"
    ),
    "currot": lambda: c.TransportCurriculum(
        SPACE, TASK.target_shares, delta=0.2, every=2, probes=2
    ),
    "adaptive_mixture": lambda: c.AdaptiveMixture(SPACE, TARGET, TASK.inputs),
    "first order": lambda: c.FirstOrderCurriculum(SPACE, TARGET, target_levels=8, candidates=2),
    "filtered bins": lambda: filtered(
        c.LearningProgressCurriculum(SPACE, source="episodes", every=2)
    ),
    "filtered replay": lambda: filtered(replay(train_on_new=True)),
    "filtered alp_gmm": lambda: filtered(
        c.MixtureCurriculum(SPACE, warmup=8, refit=6, components=3), times=2
    ),
    "transport on a model": lambda: modelled(
        filtered(
            c.TransportCurriculum(SPACE, TASK.target_shares, every=2, probes=2, exploration=0.1)
        )
    ),
    "mixture on a model": lambda: modelled(
        c.Mixed(
            [
                filtered(c.SamplingCurriculum(SPACE)),
                c.SamplingCurriculum(TARGET),
                filtered(c.TransportCurriculum(SPACE, TASK.target_shares, every=2, probes=2)),
            ],
            [1, 1, 1],
        )
    ),
    "progress on a model": lambda: modelled(c.LearningProgressCurriculum(SPACE, probes=2)),
    "edits on a model": lambda: modelled(replay("learnability", "exact", edits=3)),
    "filter on a model": lambda: modelled(filtered(c.SamplingCurriculum(SPACE))),
    "schedule": lambda: c.Schedule([c.SamplingCurriculum(SPACE), replay(train_on_new=True)], [2]),
    "filtered schedule": lambda: filtered(
        c.Schedule([c.SamplingCurriculum(TARGET), replay(train_on_new=True)], [1])
    ),
    "mixed": lambda: c.Mixed(
        [
            c.LearningProgressCurriculum(SPACE, source="episodes", every=1),
            replay(train_on_new=True),
            c.SamplingCurriculum(TARGET),
        ],
        [1, 2, 1],
    ),
}
LEARNED: dict[str, Make] = {
    "perf_gain": learnt,
    "filtered perf_gain": lambda: filtered(learnt()),
    "frozen": frozen,
    "first_order_proposer": first_order_proposer,
    "paired": paired,
    "filtered paired": lambda: filtered(paired(), times=2),
}
