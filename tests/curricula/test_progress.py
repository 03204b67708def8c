"""The bandit of learning progress, against averages written out and students that are scripts."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

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
