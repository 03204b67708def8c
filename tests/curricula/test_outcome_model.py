"""Models of outcomes against scikit-learn's, and curricula whose questions one answers."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from scipy.stats import spearmanr
from sklearn.linear_model import LogisticRegression, Ridge
from torch import Tensor

from proposer_rl import curricula as c
from proposer_rl.curricula.outcome_model import OutcomeModel, linear_ridge, logistic_ridge
from proposer_rl.runs.folder import read_csv
from proposer_rl.streams import Streams
from proposer_rl.task import space_features
from proposer_rl.teaching import Items, Parameters, Teacher
from tests.commands import SMOKE
from tests.curricula.living import student
from tests.curricula.scripted import Scripted, reached, step
from tests.tiny import TASK, sledges, tiny_view_task

M, F = 40, 5


def rows(seed: int = 0) -> tuple[Tensor, Tensor, Tensor]:
    """Features [M, F], labels and weights [M]."""
    g = torch.Generator().manual_seed(seed)
    features = torch.randn(M, F, generator=g, dtype=torch.float64)
    features[:, 0] = 1
    chance = (features @ torch.linspace(-2, 2, F).double()).sigmoid()
    labels = (torch.rand(M, generator=g) < chance).double()
    return features, labels, torch.rand(M, generator=g, dtype=torch.float64)


@pytest.mark.parametrize("between", [False, True])
@pytest.mark.parametrize("ridge", [0.01, 1.0, 30.0])
def test_logistic_regressions_are_those_of_scikit_learn(ridge: float, between: bool) -> None:
    """With labels between 0 and 1, too: there a row is two rows."""
    features, labels, weights = rows()
    labels = labels * 0.8 + 0.1 if between else labels
    found, _ = logistic_ridge(features, labels, weights, ridge)
    theirs = LogisticRegression(C=1 / ridge, fit_intercept=False, tol=1e-10, max_iter=10_000)
    theirs.fit(
        torch.cat([features, features]).numpy(),
        [1] * M + [0] * M,
        sample_weight=torch.cat([weights * labels, weights * (1 - labels)]).numpy(),
    )
    torch.testing.assert_close(found, torch.from_numpy(theirs.coef_[0]), atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("case", ["alike", "large"])
def test_it_is_found_where_labels_are_all_alike_or_features_are_large(case: str) -> None:
    """Newton's method by itself goes astray there: the slope must vanish all the same."""
    features, labels, weights = rows()
    if case == "alike":
        labels = torch.ones_like(labels)
    else:
        features = features * 100
    beta, _ = logistic_ridge(features, labels, weights, 1e-3)
    slope = features.mT @ (weights * ((features @ beta).sigmoid() - labels)) + 1e-3 * beta
    assert slope.abs().max() < 1e-6


def test_the_covariance_is_the_inverse_of_the_loss_curvature() -> None:
    features, labels, weights = rows()
    beta, covariance = logistic_ridge(features, labels, weights, 0.5)

    def loss(beta: Tensor) -> Tensor:
        p = (features @ beta).sigmoid()
        entropy = labels * p.log() + (1 - labels) * (1 - p).log()
        return -(weights * entropy).sum() + 0.25 * beta.square().sum()

    hessian = torch.autograd.functional.hessian(loss, beta)
    torch.testing.assert_close(covariance @ hessian, torch.eye(F).double())


def test_linear_regressions_are_those_of_scikit_learn() -> None:
    features, _, weights = rows()
    values = (features.square() @ torch.ones(F).double()) + 3
    found = linear_ridge(features, values, weights, 2.0)
    theirs = Ridge(alpha=2.0, fit_intercept=False)
    theirs.fit(features.numpy(), values.numpy(), sample_weight=weights.numpy())
    torch.testing.assert_close(found, torch.from_numpy(theirs.coef_))


def model_of(features: Tensor, labels: Tensor, **numbers: Any) -> OutcomeModel:
    """With a batch for each row of labels [m]; a success is a return of 1."""
    model = OutcomeModel(labels="success", **numbers)
    for phi, label in zip(features, labels, strict=True):
        model.add(phi[None], {"return": label[None], "success": label[None]})
    return model


def test_older_batches_count_less_and_the_oldest_are_forgotten() -> None:
    """The regression of the last four half-lives, with the age; its expectation, by adding up."""
    features, labels, _ = rows()
    model = model_of(features, labels, half_life=6.0, ridge=1.0)
    ages = torch.arange(23, -1, -1).double() / 6
    phi = torch.cat([-ages.unsqueeze(-1), features[-24:]], -1)
    beta, covariance = logistic_ridge(phi, labels[-24:], 0.5**ages, 1.0)
    asked = torch.cat([torch.zeros(M, 1), features], -1)
    z, deviation = asked @ beta, ((asked @ covariance) * asked).sum(-1).sqrt()
    noise = torch.linspace(-8, 8, 2001).double()
    density = torch.exp(-noise.square() / 2) / math.sqrt(2 * math.pi) * 16 / 2000
    draws = z.unsqueeze(-1) + deviation.unsqueeze(-1) * noise
    found = model.predict(features)["success"]
    torch.testing.assert_close(found, (draws.sigmoid() * density).sum(-1), atol=0.02, rtol=0)


@pytest.mark.parametrize("count", [0, 1, 3])
def test_few_outcomes_say_little(count: int) -> None:
    """Fewer than features: success is near one half where nobody has been."""
    phi = torch.eye(F).double()
    model = model_of(phi[:count], torch.zeros(count).double())
    told = model.predict(phi)
    assert all(bool(entry.isfinite().all()) for entry in told.values())
    torch.testing.assert_close(told["success"][count:], torch.full((F - count,), 0.5).double())
    assert (told["success"][:count] < 0.5).all()


def test_the_mean_of_returns_is_found() -> None:
    """A return of 40 + 10 x, give or take 5 (1 + x): the more rows, the nearer."""
    g = torch.Generator().manual_seed(0)
    off = []
    for count in (20, 4000):
        x = torch.rand(count, generator=g, dtype=torch.float64)
        phi = torch.stack([torch.ones_like(x), x, x.square()], -1)
        noise = torch.randn(x.shape, generator=g, dtype=torch.float64)
        model = OutcomeModel(labels="above_worst")
        model.add(phi, {"return": 40 + 10 * x + 5 * (1 + x) * noise})
        at = torch.linspace(0.1, 0.9, 5).double()
        told = model.predict(torch.stack([torch.ones_like(at), at, at.square()], -1))
        off.append(float((told["return"] - 40 - 10 * at).abs().max()))
    assert off[1] < 0.7 and off[0] > off[1]


def test_a_return_above_the_worst_is_a_success_where_all_failures_are_alike() -> None:
    failed, solved = -0.15, torch.tensor([0.95, 0.9, 0.85])
    returns = torch.cat([torch.full((2,), failed), solved]).double()
    success = (returns > 0).double()
    model = OutcomeModel(labels="above_worst")
    assert (model.labels({"return": returns}) == success).all()
    model.add(torch.ones(5, 1).double(), {"return": returns})
    assert (model.labels({"return": returns[2:]}) == 1).all()  # of all that is remembered


def test_on_mazes_it_ranks_levels_by_their_exact_success_the_better_the_more_it_has_seen() -> None:
    """A Solver that has not learnt, one episode on each level."""
    solver, p = student(0), TASK.batch_size
    asked = TASK.space.sample(256, Streams(0, "asked").generator())
    exact = solver.exact_performance(asked)["success"].double()
    model, ranks, squares = OutcomeModel(half_life=1e3), [], []
    for batch in range(80):
        levels = TASK.space.sample(p, Streams(0, batch).generator())
        rollout = solver.play(levels, Streams(1, batch).generator())
        reached = c.outcome_of(rollout).select("return", "success").double()
        model.add(TASK.features(levels[None])[0], dict(reached.items()))
        if batch in (0, 79):
            told = model.predict(TASK.features(asked[None])[0])["success"]
            ranks.append(spearmanr(told, exact).statistic)
            squares.append(float((told - exact).square().mean()))
    assert ranks[1] > max(ranks[0], 0.6)
    assert squares[1] < 0.5 * squares[0]
    assert squares[1] < float(exact.var())  # better than one number for all


ASKS_THE_MODEL_ALONE = [
    "+method=model_transport",
    "+method=domain_randomization +filter=model",
    "+method=learning_progress +source=model",
    "+method=ncc +source=model",
    "+method=accel +score=model",
]


@pytest.mark.parametrize("method", ASKS_THE_MODEL_ALONE)
def test_nobody_asks_the_task_how_well_the_student_does(
    method: str, train: Any, tmp_path: Path
) -> None:
    named, *more = method.split()
    lengths = ["schedule.updates=3", f"hydra.run.dir={tmp_path}"]
    assert train(named, *SMOKE, *more, *lengths) == 0
    rows = read_csv(tmp_path / "metrics.csv")
    assert {(row["evaluations"], row["curriculum_frames"]) for row in rows} == {(0, 0)}


def scripted_filter(student: Scripted, **numbers: Any) -> c.Modelled:
    uniform = SimpleNamespace(
        sample=lambda n, g: torch.randint(student.space.size, (n,), generator=g)
    )
    scorer = c.Scorer("learnability", "exact")
    chosen = c.Filtered(c.SamplingCurriculum(uniform), scorer, times=8, temperature=0.03)
    student.space.locate = lambda bins: student.space.coordinates[bins]
    return c.Modelled(chosen, lambda bins: space_features(student.space, bins), **numbers)


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
    curriculum = c.Modelled(c.SamplingCurriculum(uniform), features)
    with pytest.raises(ValueError, match="features: 3 of 3 numbers are not finite"):
        curriculum.propose(c.Student(), 3, Streams(0))


SPACES = [
    Parameters({"force": (0.5, 4.5)}, bins=4, target={"force": 4.5}),
    Items(400, features=torch.linspace(0, 1, 400)[:, None], target=[399]),
]


@pytest.mark.parametrize("space", SPACES, ids=["parameters", "many items"])
def test_a_loop_of_ones_own_has_it_without_telling_more_than_returns(space: Any) -> None:
    """What is hard is in the upper half; a return of 1 below it, at times in its middle."""
    teacher = Teacher("domain_randomization", space, filter="model")
    torch.manual_seed(0)
    for _ in range(10):
        levels = teacher.propose(32)
        place = teacher.space.locate(levels if hasattr(levels, "keys") else {"item": levels})
        teacher.observe({"return": (torch.rand(32) < (-8 * place[..., 0]).sigmoid()).float()})
    assert float((place.abs() < 0.5).float().mean()) > 0.6
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
