"""A ferry steered against a river."""

from __future__ import annotations

import pytest
import torch
from torchrl.envs import check_env_specs

from proposer_rl.tasks.arena.ways import FerryEnv
from tests.tasks.arena.first_ends import levels, played


def steered(state: dict) -> torch.Tensor:
    aside, _, current, _ = state["observation"].unbind(-1)
    return (-current - 10 * aside).unsqueeze(-1)


def still(state: dict) -> torch.Tensor:
    return torch.zeros(len(state), 1)


@pytest.mark.parametrize(
    ("current", "width", "act", "share"),
    [
        (0.7, 0.2, steered, 1.0),
        (-0.7, 0.2, steered, 1.0),
        (0.7, 0.2, still, 0.0),
        (2.0, 2.0, steered, 0.0),  # stronger than any rudder
        (0.0, 2.0, still, 1.0),
    ],
)
def test_who_lands(current: float, width: float, act: object, share: float) -> None:
    result = played(FerryEnv, levels(100, current=current, width=width), 20, act)
    assert float(result["success"].float().mean()) == share
    assert (result["steps"] == 20).all() and (result["return"] == result["success"]).all()


def test_gusts_are_fair_and_a_level_has_its_own() -> None:
    level = levels(2000, current=0.0, width=0.1)
    ends = played(FerryEnv, level, 20, still)["places"][:, -1, 0]
    # A uniform start within 0.2, and twenty uniform gusts within 0.05.
    deviation = (0.4**2 / 12 + 20 * 0.1**2 / 12) ** 0.5
    assert float(ends.mean()) == pytest.approx(0, abs=0.02)
    assert float(ends.std()) == pytest.approx(deviation, rel=0.06)
    assert (ends == played(FerryEnv, level, 20, still)["places"][:, -1, 0]).all()
    check_env_specs(FerryEnv(level[:3]), break_when_any_done="both")
