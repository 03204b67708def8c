"""Curricula whose questions a model of outcomes answers."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from proposer_rl.cli.build import build, parts
from proposer_rl.curricula import Filtered, Modelled, SamplingCurriculum, Scorer, Student
from proposer_rl.curricula.outcome_model import OutcomeModel
from proposer_rl.runs.folder import RunFolder
from proposer_rl.runs.process import StopSignals
from proposer_rl.streams import Streams
from proposer_rl.task import space_features
from proposer_rl.tasks.mazes.task import MazeTask
from proposer_rl.teaching import Items, Parameters, Teacher
from tests.commands import SMOKE
from tests.curricula.scripted import Scripted, reached, step
from tests.curricula.test_contract import same
from tests.tiny import TASK, composed, sledges, tiny_view_task

ASKS_THE_MODEL_ALONE = [
    ["+method=model_transport"],
    ["+method=domain_randomization", "+filter=model"],
    ["+method=learning_progress", "+source=model"],
    ["+method=ncc", "+source=model"],
    ["+method=accel", "+score=model"],
]


@pytest.mark.parametrize("overrides", ASKS_THE_MODEL_ALONE, ids=" ".join)
def test_nobody_asks_the_task_how_well_the_student_does(
    overrides: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []
    evaluate = MazeTask.performance

    def counted(self: MazeTask, *given: Any) -> Any:
        asked.append(given)
        return evaluate(self, *given)

    config = composed(overrides[0], *SMOKE, *overrides[1:], "schedule.updates=3")
    signals = StopSignals()
    experiment = build(config, parts(config, signals), RunFolder(tmp_path), signals)
    experiment._measure = experiment._measure_levels = lambda: None  # type: ignore[method-assign]
    experiment.summary = dict  # type: ignore[method-assign]
    monkeypatch.setattr(MazeTask, "performance", counted)
    experiment.run()
    assert not asked
    (student,) = experiment.sides.students
    assert (student.evaluations, student.frames) == (0, 0)


def scripted_filter(student: Scripted, **numbers: Any) -> Modelled:
    uniform = SimpleNamespace(
        sample=lambda n, g: torch.randint(student.space.size, (n,), generator=g)
    )
    scorer = Scorer("learnability", "exact")
    chosen = Filtered(SamplingCurriculum(uniform), scorer, times=8, temperature=0.03)
    student.space.locate = lambda bins: student.space.coordinates[bins]
    return Modelled(chosen, lambda bins: space_features(student.space, bins), **numbers)


def test_it_finds_what_is_neither_mastered_nor_out_of_reach() -> None:
    """Of nine bins the middle one is solved now and then; it soon is what is trained on."""
    torch.manual_seed(0)
    skills = torch.tensor([0.0, 0, 0, 0, 0.5, 1, 1, 1, 1])
    student = Scripted(skills)
    curriculum, shares = scripted_filter(student), []
    for update in range(12):
        streams = Streams(0, "update", update)
        batch = curriculum.propose(student, 32, streams)
        outcome = reached((torch.rand(32) < skills[batch.levels]).float())
        curriculum.observe(student, batch, outcome)
        shares.append(float((batch.levels == 4).float().mean()))
    assert shares[0] < 0.3 < 0.6 < shares[-1]
    assert not student.measured


def test_it_tells_how_right_it_was() -> None:
    """The Brier score of what it said before, against that of the share of successes."""
    student = Scripted(torch.tensor([0.0, 0.0, 0.0, 1.0]))
    curriculum = scripted_filter(student)
    step(curriculum, student, 0)
    first = curriculum.log()
    assert first["brier"] == 0.25  # one half of everything
    assert first["reliability"]["levels"] == [0, 0, 0, 0, 0, 32, 0, 0, 0, 0]
    for update in range(1, 9):
        step(curriculum, student, update)
    told = curriculum.log()
    assert told["brier"] < 0.1 * told["brier_constant"]
    levels, said, was = (torch.tensor(told["reliability"][k]) for k in told["reliability"])
    assert levels.sum() == 8 * 32
    assert ((said - was).abs() * levels).sum() / levels.sum() < 0.1
    assert curriculum.log() == {}


def test_whole_batches_are_taken_in_one_by_one() -> None:
    """As by the model itself, also where the log is read in between."""
    student = Scripted(torch.tensor([0.0, 0.3, 0.7, 1.0]))
    curriculum, model = scripted_filter(student), OutcomeModel(labels="above_worst")
    for update in range(5):
        batch = curriculum.propose(student, 16, Streams(0, "update", update))
        outcome = reached(torch.rand(16, generator=torch.Generator().manual_seed(update)))
        curriculum.observe(student, batch, outcome)
        told = {name: outcome[name].double() for name in ("return", "success")}
        model.add(space_features(student.space, batch.levels).double(), told)
        if update % 2:
            curriculum.log()
    curriculum.log()
    assert same(curriculum._model.state_dict(), model.state_dict())


def test_success_that_is_not_needed_may_be_told_of_some_levels_alone() -> None:
    """In parts of a batch, and in some batches: it makes no difference."""
    skills = torch.tensor([0.0, 0.2, 0.8, 1.0])
    predicted = []
    for told in (True, False):
        student = Scripted(skills)
        curriculum = scripted_filter(student)
        for update in range(3):
            batch = curriculum.propose(student, 8, Streams(0, update))
            outcome = reached(skills[batch.levels])
            for part in (slice(0, 4), slice(4, 8)):
                some = outcome[part]
                if not told or update == 1 or part.start:
                    some = some.exclude("success")
                curriculum.observe(student, batch[part], some)
        predicted.append(curriculum.propose(student, 8, Streams(0)).notes["predicted"])
    assert predicted[0].equal(predicted[1])


def test_features_that_are_not_finite_are_refused() -> None:
    uniform = SimpleNamespace(sample=lambda n, g: torch.zeros(n))
    features = lambda levels: levels.unsqueeze(-1) / 0  # noqa: E731
    curriculum = Modelled(SamplingCurriculum(uniform), features)
    with pytest.raises(ValueError, match="features: 3 of 3 numbers are not finite"):
        curriculum.propose(Student(), 3, Streams(0))


SPACES = {
    "parameters": lambda: Parameters({"force": (0.5, 4.5)}, bins=4, target={"force": 4.5}),
    "many items": lambda: Items(400, features=torch.linspace(0, 1, 400)[:, None], target=[399]),
}


@pytest.mark.parametrize("make", SPACES.values(), ids=SPACES)
@pytest.mark.parametrize("method", ["model_transport", "domain_randomization"])
def test_a_loop_of_ones_own_has_it_without_telling_more_than_returns(
    make: Any, method: str
) -> None:
    """What is hard is in the upper half; a return of 1 below it, at times in its middle."""
    if method == "model_transport" and make().size > 256:
        pytest.skip("transport between so many bins takes long")
    teacher = Teacher(method, make(), filter="model")
    torch.manual_seed(0)
    for _ in range(10):
        levels = teacher.propose(32)
        place = teacher.space.locate(levels if hasattr(levels, "keys") else {"item": levels})
        teacher.observe({"return": (torch.rand(32) < (-8 * place[..., 0]).sigmoid()).float()})
    middle = float((place.abs() < 0.5).float().mean())
    assert middle > 0.6 or method == "model_transport"
    assert teacher.student.frames == teacher.student.evaluations == 0


TASKS = {"mazes": lambda: TASK, "view mazes": tiny_view_task, "parameters": sledges}


@pytest.mark.parametrize("make", TASKS.values(), ids=TASKS)
def test_levels_of_a_bin_lie_in_that_bin(make: Any) -> None:
    space = make().space
    bins = torch.arange(space.size).repeat(2, 3)
    levels = space.generate(bins, [Streams(k).generator() for k in range(2)])
    features = space_features(space, levels)
    assert (features[..., -space.size :].argmax(-1) == bins).all()
    dimensions = space.coordinates.shape[1]
    assert features.shape == (2, 3 * space.size, 1 + 2 * dimensions + space.size)
    apart = features[..., 1 : 1 + dimensions] - space.coordinates[bins]
    assert apart.abs().max() < 1  # of 2, from one end of an axis to the other


def test_a_maze_without_a_way_is_no_easy_one() -> None:
    level = TASK.space.generate(torch.tensor([[0]]), [Streams(0).generator()])[0, 0]
    level.walls[:] = True
    assert TASK.space.locate(level)[1] > 1
