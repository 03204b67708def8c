"""Solvers that play on levels: against a loop over single episodes, and scripted Solvers."""

from __future__ import annotations

from typing import Any, cast

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from proposer_rl.learning import RolloutPolicy
from proposer_rl.models import ActorCritic, categorical
from proposer_rl.streams import Streams
from proposer_rl.tasks.view_mazes.task import ViewEvaluationSettings, ViewMazeSettings, ViewMazeTask
from proposer_rl.tasks.view_mazes.view_env import FORWARD, ViewMazeEnv, optimal_view_return, visits
from proposer_rl.tasks.view_mazes.view_levels import ViewLevel
from tests.tasks.view_mazes.oracles import random_levels
from tests.tiny import tiny_view_task

K, E = 2, 10


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def task(episodes: int) -> ViewMazeTask:
    """A task that plays so many episodes on each named level."""
    evaluation = ViewEvaluationSettings(distributions=["id"], levels=4, named_episodes=episodes)
    return tiny_view_task(evaluation=evaluation)


def solvers() -> ActorCritic:
    return tiny_view_task().learner([Streams(k) for k in range(K)]).agent


class Scripted:
    """Acts as a function of the state says, with a memory that counts steps."""

    copies, action_key, logits_key = 1, "action", "logits"

    def __init__(self, act: Any) -> None:
        self._act = act

    def __call__(self, state: TensorDictBase) -> TensorDictBase:
        logits = torch.full((*state.batch_size, FORWARD + 1), -1e9)
        action = self._act(state)
        state["logits"] = logits.scatter(-1, action.unsqueeze(-1), 1e9)
        state["next", "count"] = state["count"] + 1
        return state

    def no_memory(self, state: TensorDictBase) -> TensorDict:
        return TensorDict({"count": torch.zeros(state.batch_size)}, state.batch_size)

    def distribution(self, state: TensorDictBase) -> Any:
        return categorical(state["logits"])


def scripted(act: Any) -> ActorCritic:
    return cast(ActorCritic, Scripted(act))


def performance(
    agent: ActorCritic, levels: ViewLevel, limit: int, episodes: int, draws: torch.Generator
) -> TensorDictBase:
    """Of levels [E], or [K, E], of any size."""
    task = tiny_view_task(
        maze=ViewMazeSettings(height=5, width=5, max_steps=limit),
        evaluation=ViewEvaluationSettings(distributions=["id"], levels=4, episodes=episodes),
    )
    return task.performance(agent, levels, draws)


def always(action: int) -> ActorCritic:
    return scripted(lambda state: torch.full(state.batch_size, action))


@pytest.mark.slow
def test_playing_all_at_once_is_playing_one_by_one() -> None:
    """Though finished levels are left out; 30 steps are more than one check of who still plays."""
    agent, levels, limit, episodes = solvers(), random_levels(E, side=5), 30, 3
    with torch.no_grad():
        found = performance(agent, levels, limit, episodes, generator())
    noise = torch.rand(limit, episodes, E, generator=generator())
    policy = RolloutPolicy(agent)
    for i in range(E):
        total = torch.zeros(2, K)
        for episode in range(episodes):
            env = ViewMazeEnv(levels[i].expand(K, 1), max_steps=limit)
            policy.begin(noise[:, episode, i].reshape(limit, 1, 1).expand(limit, K, 1))
            with torch.no_grad():
                after = env.rollout(limit, policy, break_when_any_done=False)["next"]
            first = after["done"].long().cumsum(-2) - after["done"].long() == 0
            total[0] += (after["reward"] * first).sum((1, 2, 3))
            total[1] += (after["terminated"] & first).sum((1, 2, 3))
        torch.testing.assert_close(found["return"][:, i], total[0] / episodes)
        torch.testing.assert_close(found["success"][:, i], total[1] / episodes)
    assert 0 < float(found["success"].mean()) < 1


def test_scripted_solvers_get_what_they_must() -> None:
    levels = ViewLevel.from_text([">..G", "<..G", ">#.G"])
    straight = performance(always(FORWARD), levels, 10, 1, generator())
    assert straight["success"].tolist() == [[1.0, 0.0, 0.0]]
    torch.testing.assert_close(straight["return"][0], torch.tensor([0.73, 0.0, 0.0]))
    assert not performance(always(0), levels, 10, 1, generator())["success"].any()


def test_memory_reaches_the_next_step() -> None:
    """A Solver that turns twice and then moves, by the number of steps that it remembers."""
    counting = scripted(lambda state: torch.where(state["count"] < 2, 1, FORWARD))
    levels = ViewLevel.from_text(["G..<", "G..>"])
    found = performance(counting, levels, 10, 2, generator())
    assert found["success"].tolist() == [[0.0, 1.0]]
    torch.testing.assert_close(found["return"][0, 1], optimal_view_return(levels, 10)[1])


def test_visits_are_the_cells_of_the_best_actions() -> None:
    levels = ViewLevel.from_text([">..G", "<..G"])
    seen = visits(always(FORWARD), levels, 10)
    torch.testing.assert_close(seen[0, 0], torch.tensor([[0.0, 1 / 3, 1 / 3, 1 / 3]]))
    torch.testing.assert_close(seen[0, 1], torch.tensor([[1.0, 0.0, 0.0, 0.0]]))
    assert visits(solvers(), random_levels(3, side=5), 8).sum((-2, -1)).allclose(torch.ones(K, 3))


def test_scores_count_episodes_and_bound_them() -> None:
    agent = solvers()
    levels = {f"level {i}": level for i, level in enumerate(random_levels(3, side=5))}
    levels["wide"] = ViewLevel.from_text(">....G")
    scores = task(8).results_of(agent, levels, lambda n: 5 + n)
    assert [(s.level, s.solver) for s in scores] == [(n, k) for n in levels for k in range(K)]
    # The wide one, of another size than the others, is played alone.
    alone = performance(
        agent, levels["wide"].unsqueeze(0), 10, 8, Streams(0, "scores").generator("wide")
    )
    for score, success in zip(scores[-K:], alone["success"][:, 0].tolist(), strict=True):
        assert score.results["success"] == success
    for score in scores:
        z, found = 1.959964, score.results["success"]  # Wilson 1927: the roots in p of
        for bound in (score.results["success_low"], score.results["success_high"]):
            if 0 < bound < 1:
                assert (found - bound) ** 2 == pytest.approx(z**2 * bound * (1 - bound) / 8)
        assert score.about["max_steps"] == 5 + score.about["fewest_actions"]
    last: Tensor = torch.tensor([list(s.about.values()) for s in scores[-K:]])
    assert last.tolist() == [[1, 6, 5, 10]] * K


def test_a_certain_success_is_shown_as_such() -> None:
    hall = {"hall": ViewLevel.from_text(">.G")}
    (score,) = task(100).results_of(always(FORWARD), hall, lambda n: 10)
    assert score.results["success"] == 1 and score.results["success_high"] == 1
    assert score.results["success_low"] == pytest.approx(0.963, abs=5e-4)
