"""Every setting's default stands in two places that agree, and changing it changes numbers."""

from __future__ import annotations

import json
from dataclasses import asdict
from functools import cache
from typing import Any

import pytest

from proposer_rl.cli.build import parts
from proposer_rl.cli.config import ComputeSettings
from proposer_rl.curricula import ProposerCurriculum, TaskStudent
from proposer_rl.experiment import ScheduleSettings
from proposer_rl.learning import SolverSettings
from proposer_rl.meta.assembly import MixtureSettings, ProblemSettings, ProposerSettings
from proposer_rl.recipes import CONFIG_FOLDER
from proposer_rl.runs.process import StopSignals
from proposer_rl.streams import Streams
from proposer_rl.tasks.mazes.task import MazeSettings
from tests.commands import LITTLE
from tests.tiny import composed

ABLATIONS = sorted(
    file.stem for file in (CONFIG_FOLDER / "ablation").glob("*.yaml") if file.stem != "none"
)


def test_the_papers_values_are_the_defaults_of_the_code() -> None:
    config = composed("+method=perf_gain")
    assert config.solver == SolverSettings()
    assert config.proposer == ProposerSettings()
    assert config.schedule == ScheduleSettings()
    assert config.compute == ComputeSettings()
    assert config.task["maze"] == asdict(MazeSettings())
    problems = composed("+method=perf_gain", "proposer/action=problems")
    assert problems.proposer.action == ProblemSettings()
    assert config.proposer.action == MixtureSettings()


@cache
def first_cycle(*overrides: str) -> str:
    """The numbers of a first cycle: what is written of it, what came of Solver and Proposer."""
    config = composed("+method=perf_gain", "+scale=smoke", *LITTLE, *overrides)
    task, learner, (curriculum,) = parts(config, StopSignals())
    student = TaskStudent(task, learner)
    assert isinstance(curriculum, ProposerCurriculum) and curriculum.trainer is not None
    metrics = curriculum.improve(student, Streams(0, "cycle", 0))
    levels = [
        curriculum.propose(student, 4, Streams(0, "update", update)).to_text()
        for update in range(2)
    ]
    learnt: list[Any] = [
        [entry.double().sum().item() for entry in ppo.snapshot().values(True, True)]
        for ppo in (learner, curriculum.trainer.learner)
    ]
    return json.dumps([metrics, student.evaluations, levels, learnt])


def test_the_same_settings_give_the_same_numbers() -> None:
    again = first_cycle.__wrapped__()
    assert again == first_cycle()


@pytest.mark.parametrize("ablation", ABLATIONS)
def test_every_ablation_changes_the_first_cycle(ablation: str) -> None:
    # Of one update no mixture of two bins can be told from another: three, and an action for each.
    assert first_cycle(f"+ablation={ablation}") != first_cycle()


EPISODE = "proposer.action_repeat=1"
GAE = "proposer.advantage=gae"
PROBLEMS = "proposer/action=problems"
# Another value of every key, and the settings under which it has a meaning.
KEYS = [
    ("proposer.rollouts=3", []),
    ("proposer.meta_episode_length=4", []),
    ("proposer.action_repeat=1", []),
    ("proposer.validation_levels=8", []),
    ("proposer.probe_levels=1", []),
    ("proposer.observes=[return]", []),
    ("proposer.own_action=sample", []),
    ("proposer.advantage=gae", [EPISODE]),  # of one action both are the reward, standardised
    ("proposer.context=4", []),
    ("proposer.hidden=4", []),
    ("proposer.ppo.updates=2", []),
    ("proposer.ppo.epochs=3", []),
    ("proposer.ppo.learning_rate=0.01", []),
    ("proposer.ppo.adam_eps=0.1", []),
    ("proposer.ppo.gamma=0.5", [EPISODE]),
    ("proposer.ppo.lmbda=0.1", [EPISODE, GAE]),
    ("proposer.ppo.clip_epsilon=0.001", ["proposer.ppo.learning_rate=0.1"]),
    ("proposer.ppo.entropy_coeff=0.5", []),
    ("proposer.ppo.critic_coeff=0.1", [GAE]),
    ("proposer.ppo.max_grad_norm=0.001", []),
    ("proposer.ppo.normalize_advantage=false", []),
    ("proposer.action.spread=0.5", []),
    ("proposer.action.ratio=joint", [PROBLEMS, "proposer.ppo.learning_rate=0.1"]),
    ("proposer.action.bands=3", [PROBLEMS]),
]


@pytest.mark.parametrize(("change", "under"), KEYS, ids=[change for change, _ in KEYS])
def test_every_key_of_the_proposer_changes_the_first_cycle(change: str, under: list[str]) -> None:
    assert first_cycle(*under, change) != first_cycle(*under)


def test_no_key_of_the_proposer_is_forgotten() -> None:
    tried = {change.partition("=")[0] for change, _ in KEYS}
    for kind in ("mixture", "problems"):
        proposer = asdict(composed("+method=perf_gain", f"proposer/action={kind}").proposer)
        nested = {key: proposer.pop(key) for key in ("ppo", "action")}
        names = {f"proposer.{key}" for key in proposer}
        names |= {f"proposer.{key}.{inner}" for key, value in nested.items() for inner in value}
        assert names - {"proposer.action.kind"} <= tried


# What the sources' own files say: q, T, staleness, score, whether new levels are trained on, edits.
SOURCES = {
    ("robust_plr", "dcd"): (0.5, 0.1, 0.3, "max_mc", False, 0),
    ("accel", "dcd_accel"): (0.8, 0.3, 0.3, "positive_value_loss", False, 5),
    ("robust_plr", "minimax"): (0.5, 0.3, 0.3, "max_mc", False, 0),
    ("accel", "minimax_accel"): (0.5, 0.3, 0.5, "max_mc", False, 20),
    ("robust_plr", "jaxued"): (0.8, 0.3, 0.3, "max_mc", False, 0),
    ("accel", "jaxued_accel"): (0.8, 0.3, 0.3, "max_mc", False, 5),
    ("plr", "sfl"): (0.5, 1.0, 0.3, "max_mc", True, 0),
    ("accel", "sfl_accel"): (0.5, 1.0, 0.3, "max_mc", True, 20),
}


@pytest.mark.parametrize(("method", "source"), SOURCES)
def test_a_source_has_its_own_numbers(method: str, source: str) -> None:
    chosen = composed(f"+method={method}", f"+as={source}").curriculum
    keys = ("replay_probability", "temperature", "staleness", "score", "train_on_new", "edits")
    assert tuple(chosen[key] for key in keys) == SOURCES[method, source]
    assert chosen["capacity"] == 4000
    parts(composed(f"+method={method}", "+scale=smoke", f"+as={source}"), StopSignals())


def test_every_source_is_tried() -> None:
    there = {file.stem for file in (CONFIG_FOLDER / "as").glob("*.yaml")}
    assert there == {source for _, source in SOURCES}


@pytest.mark.parametrize("method", ["regret", "sfl", "ncc", "pace"])
def test_what_is_exact_has_a_sampled_twin(method: str) -> None:
    costs = {}
    for options in ((), ("+score=sampled",)):
        config = composed(f"+method={method}", "+scale=smoke", *LITTLE, *options)
        task, learner, (curriculum,) = parts(config, StopSignals())
        student = TaskStudent(task, learner)
        curriculum.propose(student, task.batch_size, Streams(0, "update", 0))
        costs[options] = (student.frames > 0, student.evaluations > 0)
    assert costs == {(): (False, True), ("+score=sampled",): (True, False)}
