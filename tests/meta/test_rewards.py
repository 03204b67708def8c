"""Rewards against numbers worked out by hand."""

from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

from proposer_rl.meta.rewards import (
    TrainingStep,
    log_success_gain,
    performance_gain,
    task_difficulty,
)
from proposer_rl.task import NoSuccessError


def performance(**values: list[list[float]]) -> TensorDict:
    entries = {name: torch.tensor(value) for name, value in values.items()}
    return TensorDict(entries, next(iter(entries.values())).shape)


def step(before: TensorDict, after: TensorDict) -> TrainingStep:
    return TrainingStep(None, None, None, before, after)  # type: ignore[arg-type]


def test_gain_is_the_increase_of_the_mean_return() -> None:
    before = performance(**{"return": [[0.1, 0.3], [0.5, 0.5]]})
    after = performance(**{"return": [[0.5, 0.3], [0.0, 0.5]]})
    torch.testing.assert_close(performance_gain(step(before, after)), torch.tensor([0.2, -0.25]))


def test_log_success_gain_is_the_increase_of_the_mean_logarithm() -> None:
    before, after = ([[0.0, 0.009]], [[0.0, 0.999]])
    given = step(
        *(
            performance(**{"success": success, "return": [[1.0, 1.0]]})
            for success in (before, after)
        )
    )
    expected = torch.tensor([math.log(100) / 2])
    torch.testing.assert_close(log_success_gain(given), expected)


def test_log_success_needs_a_task_that_tells_success() -> None:
    only_return = performance(**{"return": [[1.0]]})
    with pytest.raises(NoSuccessError, match=r"tells no success.*rewards\.performance_gain") as no:
        log_success_gain(step(only_return, only_return))
    assert no.value.exit_code == 2


def rollout(*episodes: str) -> TensorDict:
    """One row per environment: '.' goes on, 'G' terminates, 'T' truncates."""

    def flag(mark: str) -> Tensor:
        return torch.tensor([[here == mark for here in row] for row in episodes])[None, ..., None]

    steps = {"terminated": flag("G"), "done": flag("G") | flag("T")}
    return TensorDict({"next": steps}, [1, len(episodes), len(episodes[0])])


def test_difficulty_is_the_failure_rate() -> None:
    batch = rollout("..G.", "..TG", "....", "G.T.")
    given = TrainingStep(None, batch, None, None, None)  # type: ignore[arg-type]
    torch.testing.assert_close(task_difficulty(given), torch.tensor([0.5]))
