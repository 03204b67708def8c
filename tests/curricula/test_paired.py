"""PAIRED: the reward is the regret between two students, and both train."""

from __future__ import annotations

import pytest
import torch

from proposer_rl import methods
from proposer_rl.learning import PPOSettings, SolverSettings
from proposer_rl.meta.assembly import ProposerSettings
from proposer_rl.methods import Components
from proposer_rl.settings import ArgumentError
from proposer_rl.streams import Streams
from tests.curricula.living import TASK, live, solvers, student
from tests.curricula.made import filtered, paired
from tests.tasks.gymnasium.toys import walk_task
from tests.tiny import evaluate

P, T = 4, 8


def test_equal_students_have_no_regret() -> None:
    curriculum = paired(Streams(0, "solver"))  # the protagonist's own
    levels = TASK.space.sample(P, torch.Generator().manual_seed(0))
    regret, metrics = curriculum.reward(student(0), levels, Streams(0))
    assert (regret == 0).all() and metrics["regret"] == 0


@pytest.mark.parametrize("times", [1, 2])
def test_the_reward_is_what_the_antagonist_gets_more(times: int) -> None:
    curriculum, learner = paired(), solvers([0])
    antagonist = TASK.learner([Streams(0, "antagonist")]).agent
    levels = TASK.space.sample(P, torch.Generator().manual_seed(2))
    regret, _ = curriculum.reward(student(0), levels, Streams(0))
    other, own = (evaluate(agent, levels)["return"][0] for agent in (antagonist, learner.agent))
    torch.testing.assert_close(regret, (other - own).clamp_min(0))
    assert float(regret.max()) > 0
    whole = curriculum if times == 1 else filtered(curriculum, times=times)
    (lived,) = live([whole], learner, [0], range(4))
    # Both students on all that is drawn; the antagonist trains on what the protagonist trained on.
    assert lived.frames == [P * T] * 4
    assert lived.evaluations == [2 * times * P + (times > 1) * times * P] * 4
    assert int(torch.tensor(lived.told[-1]["histogram"]).sum()) == 3 * P


def test_the_antagonist_trains_on_the_same_levels_with_its_own_chance() -> None:
    curriculum, learner = paired(), solvers([0])
    plain = TASK.learner([Streams(0, "antagonist")])
    (lived,) = live([curriculum], learner, [0], range(2))
    for number, levels in enumerate(lived.levels):
        plain.env.set_levels(levels.unsqueeze(0))
        plain.update([Streams(0, "update", number).generator("antagonist")])
    assert (plain.snapshot()[0] == curriculum.antagonist.snapshot()).all()


def test_it_has_no_second_solver_whose_episodes_go_on() -> None:
    ppo = PPOSettings(horizon=8, continue_episodes=True)
    task = walk_task(solver=SolverSettings(batch_size=P, ppo=ppo))
    components = Components(task, ProposerSettings(), 0)
    with pytest.raises(ArgumentError, match=r"^continue_episodes=True: the second Solver"):
        methods.paired(components)
