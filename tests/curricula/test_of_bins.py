"""What holds of every curriculum that draws from the bins by what Solvers do there, on mazes."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import pytest
import torch

from proposer_rl.curricula import (
    Choice,
    Curriculum,
    LearningProgressCurriculum,
    MixtureCurriculum,
    Scorer,
    TransportCurriculum,
)
from proposer_rl.learning import PPO
from proposer_rl.runs.checkpoint import load_checkpoint, save_checkpoint
from proposer_rl.streams import Streams
from tests.tiny import TASK, learners

SCORER = Scorer(TASK, "learnability", "exact")
K, P, N = 2, TASK.batch_size, TASK.space.size
SMOKE = ("+scale=smoke", "compute.progress=false", "hydra.run.dir=run")
Make = Callable[[], Curriculum]

MAKERS: dict[str, Make] = {
    "probes": lambda: LearningProgressCurriculum(TASK, probes=2, every=2),
    "episodes": lambda: LearningProgressCurriculum(TASK, source="episodes", every=2),
    "mixtures": lambda: MixtureCurriculum(TASK, warmup=8, refit=6, components=3),
    "exact mixtures": lambda: MixtureCurriculum(
        TASK, source="exact", warmup=8, refit=6, components=3
    ),
    "a choice": lambda: LearningProgressCurriculum(
        TASK, probes=2, every=2, choice=Choice(SCORER, times=2, temperature=0.1)
    ),
    "transport": lambda: TransportCurriculum(TASK, delta=0.2, every=2, probes=2),
}


@pytest.fixture(params=MAKERS.values(), ids=MAKERS)
def make(request: pytest.FixtureRequest) -> Make:
    return request.param


def train(
    curriculum: Curriculum, solvers: PPO, updates: range, seeds: tuple[int, ...] = (0, 1)
) -> list[Any]:
    proposals = []
    for update in updates:
        streams = [Streams(seed, "update", update) for seed in seeds]
        proposal = curriculum.propose(solvers, update, streams)
        solvers.env.set_levels(proposal.levels)
        done = solvers.update([s.generator("actions") for s in streams])
        curriculum.observe(solvers, proposal.levels, done)
        proposals.append(proposal)
    return proposals


def told(curriculum: Curriculum, solvers: PPO) -> dict[str, Any]:
    return curriculum.improve(solvers, 0, [Streams(0)] * K).metrics


@pytest.mark.parametrize("stop", [3, 4])  # of mixtures, at a fit and between two
def test_a_resumed_one_goes_on_bit_by_bit(make: Make, stop: int, tmp_path) -> None:
    straight, solvers = make(), learners(K)
    expected = train(straight, solvers, range(8))
    interrupted, others = make(), learners(K)
    train(interrupted, others, range(stop))
    # Through a file, as in a run.
    saved = save_checkpoint(tmp_path, 0, {"curriculum": interrupted.state_dict()})
    resumed, again = make(), learners(K)
    resumed.load_state_dict(load_checkpoint(saved)[1]["curriculum"])
    again.restore(others.snapshot())
    for one, other in zip(train(resumed, again, range(stop, 8)), expected[stop:], strict=True):
        assert (one.levels == other.levels).all() and one[1:] == other[1:]
    assert told(resumed, again) == told(straight, solvers)


def test_a_state_is_that_of_its_moment(make: Make) -> None:
    curriculum, solvers = make(), learners(K)
    train(curriculum, solvers, range(4))
    state, twin = curriculum.state_dict(), make()
    train(curriculum, solvers, range(4, 7))
    twin.load_state_dict(state)
    fresh, reference = make(), learners(K)
    train(fresh, reference, range(4))
    assert told(twin, solvers) == told(fresh, reference)


def test_several_solvers_do_what_each_does_alone(make: Make) -> None:
    both = train(make(), learners(2), range(7), (5, 6))
    alone = train(make(), learners(1), range(7), (6,))
    for one, other in zip(both, alone, strict=True):
        assert one.levels.batch_size == (2, P)
        assert (one.levels[1] == other.levels[0]).all() and one[1:] == other[1:]
    assert not all((one.levels[0] == one.levels[1]).all() for one in both)


def test_a_fresh_solver_finds_nothing_of_the_last_one(make: Make) -> None:
    curriculum, solvers = make(), learners(K)
    train(curriculum, solvers, range(7))
    curriculum.begin()
    assert curriculum.improve(solvers, 0, [Streams(0)] * K).metrics == {}
    again = train(curriculum, learners(K), range(7), (3, 4))
    expected = train(make(), learners(K), range(7), (3, 4))
    for one, other in zip(again, expected, strict=True):
        assert (one.levels == other.levels).all()


def test_choosing_leaves_the_solvers_as_they_are(make: Make) -> None:
    curriculum, solvers = make(), learners(K)
    train(curriculum, solvers, range(3))
    before = solvers.snapshot()
    curriculum.propose(solvers, 4, [Streams(0), Streams(1)])
    assert (solvers.snapshot() == before).all()


def test_a_cycle_is_told_in_json_once(make: Make) -> None:
    curriculum, solvers = make(), learners(K)
    assert curriculum.improve(solvers, 0, [Streams(0)] * K).metrics == {}
    train(curriculum, solvers, range(5))
    metrics = json.loads(json.dumps(told(curriculum, solvers), allow_nan=False))
    histogram = torch.tensor(metrics["histogram"])
    assert (histogram.shape, int(histogram.sum())) == ((2, 2), 5 * K * P)
    assert int(torch.tensor(told(curriculum, solvers)["histogram"]).sum()) == 0


@pytest.mark.usefixtures("own_folder")
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["+method=learning_progress", "curriculum.fast=1"], "curriculum: fast must be from 0 to"),
        (["+method=alp_gmm", "curriculum.refit=300"], "components=10 must be at most refit=300"),
        (["+method=currot", "curriculum.epsilon=.nan"], "curriculum: epsilon must be a finite"),
        (["+method=currot", "compute.collector=multiprocess"], "this method trains no copies"),
    ],
)
def test_the_command_refuses_in_one_line(
    arguments: list[str], message: str, train, capsys: pytest.CaptureFixture[str]
) -> None:
    capsys.readouterr()  # what was said before is not the command's
    assert train(*arguments, *SMOKE) == 2
    said = capsys.readouterr().err
    errors = [line for line in said.splitlines() if line.startswith("error: ")]
    assert len(errors) == 1 and message in errors[0], said


@pytest.mark.usefixtures("own_folder")
@pytest.mark.parametrize("method", ["learning_progress", "currot", "alp_gmm"])
def test_the_command_trains_with_it(method: str, train) -> None:
    small = ["curriculum.warmup=8", "curriculum.refit=8", "curriculum.components=2"]
    assert train(f"+method={method}", *SMOKE, *(small if method == "alp_gmm" else [])) == 0
