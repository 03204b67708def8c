"""A corridor with a number in mind."""

from __future__ import annotations

import pytest
import torch
from torchrl.envs import check_env_specs

from proposer_rl.tasks.arena.ways import RecallEnv
from tests.tasks.arena.first_ends import levels, played


class Walker:
    """Walks on to the end, and goes through the door that it saw first, or last."""

    def __init__(self, first: bool) -> None:
        self.first, self.door = first, None

    def __call__(self, state: dict) -> torch.Tensor:
        number, last = state["observation"][..., :4], state["observation"][..., 5]
        shown = number.argmax(-1)
        if self.door is None:
            self.door = shown
        elif not self.first:
            self.door = torch.where(number.any(-1), shown, self.door)
        return torch.where(last > 0, 1 + self.door, 0)


@pytest.mark.parametrize("length", [2, 5, 12])
def test_what_was_shown_first_opens_the_right_door(length: int) -> None:
    result = played(RecallEnv, levels(200, length=length, noise=1.0), 24, Walker(first=True))
    assert result["success"].all() and (result["steps"] == length).all()
    assert (result["return"] == 1).all()


def test_what_is_shown_on_the_way_means_nothing() -> None:
    by_chance = played(RecallEnv, levels(2000, length=6, noise=1.0), 24, Walker(first=False))
    assert float(by_chance["success"].float().mean()) == pytest.approx(1 / 4, abs=0.04)
    quiet = played(RecallEnv, levels(200, length=6, noise=0.0), 24, Walker(first=False))
    assert quiet["success"].all()


def test_the_door_cannot_be_read_off_later_and_doors_are_equally_likely() -> None:
    env = RecallEnv(levels(2000, length=6, noise=0.0))
    state = env.reset()
    share = state["observation"][..., :4].mean(0)
    assert share.tolist() == pytest.approx([0.25] * 4, abs=0.04)
    later = env.step(state.set("action", torch.zeros(2000, dtype=torch.long)))["next"]
    assert later["observation"].unique(dim=0).shape[0] == 1
    check_env_specs(RecallEnv(levels(3, length=6, noise=0.5)), break_when_any_done="both")
