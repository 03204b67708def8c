"""Learning progress and ALP-GMM: tables, brute force, moments, and students that are scripts."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from sklearn.mixture import GaussianMixture
from tensordict import TensorDict
from torch import Tensor

from proposer_rl.curricula import gaussian_mixtures, points
from proposer_rl.curricula.gaussian_mixtures import (
    MixtureCurriculum,
    absolute_progress,
    draw_points,
    fit_mixture,
)
from proposer_rl.curricula.points import nearest
from proposer_rl.curricula.progress import LearningProgressCurriculum
from proposer_rl.streams import Streams
from tests.curricula.scripted import Scripted, reached, step

N = 4


def written_out(seen: Tensor, fast: float, slow: float) -> tuple[Tensor, Tensor]:
    """Both averages after looks [T], as weighted sums of all looks."""

    def average(values: list[Tensor], old: float) -> Tensor:
        last = len(values) - 1
        weights = [old**last, *(old ** (last - i) * (1 - old) for i in range(1, last + 1))]
        return sum((w * v for w, v in zip(weights, values, strict=True)), torch.zeros(()))

    quick = [average(list(seen[: t + 1]), fast) for t in range(len(seen))]
    return quick[-1], average(quick, slow)


@pytest.mark.parametrize("measure", ["success", "return"])
def test_shares_follow_the_distance_of_two_averages(measure: str) -> None:
    seen = torch.rand(6, N, generator=torch.Generator().manual_seed(0))
    task = Scripted(seen[0])
    curriculum = LearningProgressCurriculum(
        task.space, probes=3, fast=0.7, slow=0.8, exploration=0.3, measure=measure
    )
    for update, skills in enumerate(seen):
        task.skills = skills
        step(curriculum, task, update)
    progress = torch.zeros(N)
    for n in range(N):
        fast, slow = written_out(seen[:, n], 0.7, 0.8)
        if measure == "success":  # with q = 0.1
            fast, slow = (0.9 * p / (0.8 * p + 0.1) for p in (fast, slow))
        progress[n] = abs(fast - slow)
    expected = 0.7 * progress / progress.sum() + 0.3 / N
    torch.testing.assert_close(curriculum.shares(), expected, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("source", ["exact", "episodes"])
def test_the_mass_moves_to_what_is_learnt_and_leaves_when_it_is(source: str) -> None:
    """The last two bins: one is learnt from update 10 to 29; the other never changes."""
    task = Scripted(torch.zeros(N), batch_size=40)
    curriculum = LearningProgressCurriculum(
        task.space, source=source, fast=0.7, slow=0.9, exploration=0.2, measure="return"
    )
    task.skills = torch.tensor([0.0, 1.0, 0.0, 0.5])
    counts = []
    for update in range(120):
        task.skills[2] = min(1.0, max(0.0, (update - 9) / 20))
        counts.append(step(curriculum, task, update).bincount(minlength=N))
    assert (torch.stack(counts[:10]) == 10).all()
    learning = torch.stack(counts[13:29])
    assert (learning[:, 2] == 34).all() and (learning[:, [0, 1, 3]] == 2).all()
    # All that is left at the end is what the averages still remember of it.
    told = torch.tensor(curriculum.log()["score"])
    assert told[2] < 1e-2 and (told[[0, 1, 3]] == 0).all()


def test_probes_are_fixed_and_counted() -> None:
    task = Scripted(torch.rand(N))
    task.space.generate = lambda choices, generators: (
        choices
        + N * torch.stack([torch.randint(1000, choices.shape[1:], generator=g) for g in generators])
    )
    measured = []

    def performance(levels: Tensor, generator: torch.Generator) -> TensorDict:
        measured.append(levels)
        return Scripted.performance(task, levels % N, generator)

    task.performance = performance  # type: ignore[method-assign]
    for run in range(2):
        curriculum = LearningProgressCurriculum(task.space, probes=3, every=2)
        for update in range(4):
            task.evaluations = 0
            curriculum.propose(task, 8, Streams(5, run, update))
            assert task.evaluations == (3 * N if update % 2 == 0 else 0)
    first, again, other, _ = measured
    assert torch.equal(first, again) and not torch.equal(first, other)
    assert torch.equal(first % N, torch.arange(N).repeat_interleave(3))


def test_episodes_are_the_first_ones_since_the_last_look() -> None:
    generator = torch.Generator().manual_seed(1)
    task = Scripted(torch.zeros(N), batch_size=3)
    curriculum = LearningProgressCurriculum(
        task.space, source="episodes", every=3, fast=0.6, slow=0.5, exploration=1.0
    )
    averages: dict[int, tuple[float, float]] = {}
    since: dict[int, list[float]] = {}
    for update in range(13):
        batch = curriculum.propose(task, 3, Streams(0, update))
        if update % 3 == 0:
            for place, seen in since.items():
                mean = sum(seen) / len(seen)
                fast, slow = averages.get(place, (mean, mean))
                fast = 0.6 * fast + 0.4 * mean
                averages[place] = fast, 0.5 * slow + 0.5 * fast
            since = {}
        expected = torch.zeros(N)
        for place, (fast, slow) in averages.items():
            expected[place] = abs(0.9 * fast / (0.8 * fast + 0.1) - 0.9 * slow / (0.8 * slow + 0.1))
        torch.testing.assert_close(curriculum.scores["score"], expected)
        solved = torch.rand(3, generator=generator) < 0.5
        for place, won in zip(batch.levels.tolist(), solved.tolist(), strict=True):
            since.setdefault(place, []).append(float(won))
        curriculum.observe(task, batch, reached(torch.rand(3), solved))
    assert task.measured == []
    assert len(averages) == N


TASKS = torch.tensor([[0.1], [0.2], [0.4], [0.6], [0.8], [0.9]])
REWARDS = torch.tensor([0.2, 0.0, 0.5, 0.5, 0.1, 0.3])


def test_progress_is_the_distance_to_the_nearest_of_more_than_five_earlier_returns() -> None:
    new, reward = torch.tensor([[0.25]]), torch.tensor([0.3])
    torch.testing.assert_close(absolute_progress(TASKS, REWARDS, new, reward), torch.tensor([0.3]))
    tasks, rewards = torch.cat([TASKS, new]), torch.cat([REWARDS, reward])
    assert absolute_progress(tasks, rewards, new, reward).tolist() == [0.0]
    assert absolute_progress(TASKS[:5], REWARDS[:5], new, reward).tolist() == [0.0]  # too few


@pytest.mark.parametrize("chunk", [3, 2**16])
@given(data=st.data())
def test_the_nearest_is_that_of_a_loop_and_the_last_of_equals(
    chunk: int, data: st.DataObject
) -> None:
    coordinate = st.integers(-3, 3).map(float)
    point = st.tuples(coordinate, coordinate)
    places = data.draw(st.lists(point, min_size=1, max_size=12))
    drawn = data.draw(st.lists(point, min_size=1, max_size=5))
    expected = [
        max((-math.dist(p, place), index) for index, place in enumerate(places))[1] for p in drawn
    ]
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(points, "CHUNK", chunk)
        assert nearest(torch.tensor(drawn), torch.tensor(places)).tolist() == expected


def clusters(generator: torch.Generator) -> torch.Tensor:
    """Points [300, 3] around three places."""
    middles = torch.tensor([[-0.8, 0.0, 0.1], [0.0, 0.9, 0.9], [0.8, -0.9, 0.4]])
    noise = 0.05 * torch.randn(3, 100, 3, generator=generator)
    return (middles.unsqueeze(1) + noise).flatten(0, 1)


def test_a_mixture_has_the_least_aic() -> None:
    points = clusters(torch.Generator().manual_seed(0))
    found, _ = fit_mixture(points, 6, torch.Generator().manual_seed(1))
    # Written out: 2 * (numbers of the model) - 2 * log-likelihood, D + 1 = 3 coordinates.
    scores = {}
    for count in range(2, 7):
        seeds = torch.randint(2**31, (5,), generator=torch.Generator().manual_seed(1))
        model = GaussianMixture(count, random_state=int(seeds[count - 2])).fit(points.numpy())
        numbers = count - 1 + 3 * count + 6 * count
        scores[count] = 2 * numbers - 2 * model.score_samples(points.double().numpy()).sum()
    assert len(found) == min(scores, key=scores.__getitem__)
    if len(found) == 3:
        expected = points.double().unflatten(0, (3, 100)).mean(1)
        order = found[:, 0].argsort()
        torch.testing.assert_close(found[order], expected, atol=1e-4, rtol=0)


def test_points_that_are_all_alike_make_a_mixture_without_a_warning(
    recwarn: pytest.WarningsRecorder,
) -> None:
    found = fit_mixture(torch.zeros(20, 3), 5, torch.Generator())
    drawn = draw_points(*found, 1000, torch.Generator())
    assert drawn.abs().max() < 0.1
    assert len(recwarn) == 0


def test_gaussians_are_drawn_by_their_progress_and_with_their_moments() -> None:
    covariance = torch.tensor([[0.04, 0.03, 0.01], [0.03, 0.09, 0.0], [0.01, 0.0, 0.5]])
    mixture = (
        torch.tensor([[-5.0, 1.0, 0.6], [5.0, 2.0, 0.2], [0.0, 50.0, 0.0]]).double(),
        covariance.double().expand(3, 3, 3),
    )
    count = 40_000
    drawn = draw_points(*mixture, count, torch.Generator().manual_seed(3))
    assert (drawn[:, 1] < 20).all()  # that without progress never
    left = drawn[:, 0] < 0
    assert float(left.double().mean()) == pytest.approx(0.75, abs=4 * math.sqrt(0.19 / count))
    torch.testing.assert_close(
        drawn[left].mean(0), torch.tensor([-5.0, 1.0]).double(), atol=0.01, rtol=0
    )
    torch.testing.assert_close(drawn[left].T.cov(), covariance[:2, :2].double(), atol=3e-3, rtol=0)


def test_without_progress_all_gaussians_are_alike() -> None:
    means = torch.tensor([[-1.0, 0.0], [1.0, 0.0]]).double()
    spread = torch.diag(torch.tensor([1e-4, 1.0])).double().expand(2, 2, 2)
    drawn = draw_points(means, spread, 10_000, torch.Generator().manual_seed(4))
    assert float((drawn > 0).double().mean()) == pytest.approx(0.5, abs=0.02)


def small(task: Scripted, **options: Any) -> MixtureCurriculum:
    return MixtureCurriculum(task.space, **{"warmup": 64, "refit": 64, "components": 4, **options})


def test_a_warm_up_is_even_and_its_draws_are_rounded() -> None:
    task = Scripted(torch.zeros(5), batch_size=4000)
    curriculum = small(task, warmup=4000, refit=4000)
    bins = step(curriculum, task, 0).bincount(minlength=5) / 4000
    curriculum.log()
    # The bins are half a unit apart, so that half of an outermost one lies outside of the box.
    np.testing.assert_allclose(bins, [1 / 8, 1 / 4, 1 / 4, 1 / 4, 1 / 8], atol=0.03)
    history = curriculum.state_dict()["history"]
    points, tasks = history["points"][:, 0], history["tasks"][:, 0]
    assert (points.abs() <= 1).all() and len(points.unique()) > 3900
    assert ((points - tasks).abs() <= 0.25).all() and len(tasks.unique()) == 5


def test_a_mixture_moves_to_what_is_learnt_and_leaves_when_it_is() -> None:
    """Bins 0 and 1 are learnt from update 10 to 29; the others never change."""
    task = Scripted(torch.zeros(8), batch_size=32)
    curriculum = small(task)
    shares = []
    for update in range(60):
        task.skills = torch.zeros(8)
        task.skills[5:] = 0.7
        task.skills[:2] = min(max(update - 9, 0) / 20, 1.0)
        shares.append(float((step(curriculum, task, update) <= 1).double().mean()))
    even = 1.5 / 7  # of the box
    assert np.mean(shares[:8]) == pytest.approx(even, abs=0.15)
    assert np.mean(shares[14:30]) > 2 * even
    assert np.mean(shares[40:]) < np.mean(shares[14:30]) / 2


def test_progress_is_against_earlier_updates_alone() -> None:
    task = Scripted(torch.zeros(8), batch_size=8)
    curriculum = small(task)
    returns = torch.rand(4, 8, generator=torch.Generator().manual_seed(6)).double()
    for update in range(4):
        batch = curriculum.propose(task, 8, Streams(0, update))
        curriculum.observe(task, batch, reached(returns[update]))
    curriculum.log()
    history = curriculum.state_dict()["history"]
    # Seven steps between eight bins: a bin's number.
    bins = ((history["tasks"][:, 0] + 1) * 3.5).round()
    earlier = returns.flatten()
    for row in range(8, 32):
        apart = (bins[: row // 8 * 8] - bins[row]).abs()
        neighbour = max(int(i) for i in (apart == apart.min()).nonzero())
        assert float(history["progress"][row]) == pytest.approx(
            abs(float(earlier[row] - earlier[neighbour]))
        )
    assert (history["progress"][:8] == 0).all()
    torch.testing.assert_close(history["returns"], earlier)


def test_mixtures_are_made_of_the_last_window_when_it_is_full(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made: list[torch.Tensor] = []

    def noted(points: torch.Tensor, most: int, generator: torch.Generator) -> Any:
        made.append(points)
        return fit_mixture(points, most, generator)

    monkeypatch.setattr(gaussian_mixtures, "fit_mixture", noted)
    task = Scripted(torch.rand(8), batch_size=24)
    curriculum = small(task, warmup=70, refit=50)
    fitted = []
    for update in range(10):
        before = len(made)
        step(curriculum, task, update)
        fitted += [24 * update] * (len(made) - before)
    assert fitted == [72, 120, 168, 216]  # the first of at least 70, and each beyond a further 50
    history = curriculum.state_dict()["history"]
    last = torch.cat([history["points"], history["progress"].unsqueeze(-1)], -1)[216 - 50 : 216]
    assert torch.equal(made[-1], last)


def test_draws_beyond_the_box_are_clipped_and_told() -> None:
    task = Scripted(torch.zeros(5), batch_size=5000)
    curriculum = small(task, exploration=0.3)
    state = curriculum.state_dict()
    means = torch.tensor([[0.9, 0.5]]).double()
    covariances = torch.diag(torch.tensor([0.01, 0.2])).double().unsqueeze(0)
    state["mixture"] = [means, covariances]
    curriculum.load_state_dict(state)
    step(curriculum, task, 0)
    told = json.loads(json.dumps(curriculum.log()))
    beyond = 0.5 * math.erfc(1 / math.sqrt(2))  # of a Gaussian, more than one deviation up
    assert told["clipped"] == pytest.approx(beyond, abs=0.02)
    points = curriculum.state_dict()["history"]["points"][:, 0]
    assert float((points == 1).double().mean()) == pytest.approx(0.7 * beyond, abs=0.02)
    assert told["components"] == 1 and told["means"] == [[pytest.approx(0.9), 0.5]]
    assert sum(told["histogram"]) == 5000
    step(curriculum, task, 1)
    assert sum(curriculum.log()["histogram"]) == 5000


def test_without_scikit_learn_a_line_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("proposer_rl.curricula.gaussian_mixtures.find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r"install it with: .*\[alp-gmm\]'?$"):
        small(Scripted(torch.zeros(3)))
