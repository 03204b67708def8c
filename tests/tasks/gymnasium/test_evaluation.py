"""Episodes tell what policies reach: compared with plain loops over Gymnasium's environments."""

from __future__ import annotations

from typing import Any

import gymnasium
import pytest
import torch

from proposer_rl.streams import Streams
from proposer_rl.tasks.gymnasium.task import EvaluationSettings
from tests.tasks.gymnasium.toys import WALK, set_wind, walk_task

K, E = 2, 5
TASK = walk_task()


def solvers(task: Any = TASK, copies: int = K) -> Any:
    """Solvers of which one tends to the left a little, the other to the right."""
    agent = task.learner([Streams(copy) for copy in range(copies)]).agent
    with torch.no_grad():
        for name, parameter in agent.named_parameters():
            if parameter.shape[1:] == (2,) and "stacked" in name:  # the policy's last biases
                parameter += torch.tensor([[0.0, -0.3], [0.0, 3.0]])[:copies]
    return agent


def by_hand(agent: Any, copy: int, level: Any, greedy: bool, numbers: torch.Generator) -> Any:
    """Return and success of one episode."""
    env: Any = gymnasium.make(WALK, width=level["width"].item())
    env.unwrapped.engine.speed = level["speed"].item()
    set_wind(env.unwrapped, level["wind"].item())
    seen, _ = env.reset(seed=level["seed"].item(), options={"start": level["begin"].item()})
    total, terminated, truncated = 0.0, False, False
    while not (terminated or truncated):
        state = torch.tensor(seen, dtype=torch.float32).expand(agent.copies, 1, 2)
        with torch.no_grad():
            logits = agent.head.module(state)[0][copy, 0]
        draw = int(torch.multinomial(logits.softmax(-1), 1, generator=numbers))
        action = int(logits.argmax()) if greedy else draw
        seen, reward, terminated, truncated, _ = env.step(1 + action)
        total += reward
    return total, float(terminated)


def test_the_most_probable_actions_give_what_a_loop_gives() -> None:
    task = walk_task(evaluation=EvaluationSettings(levels=4, actions="most_probable"))
    agent, levels = solvers(task), task.space.sample(E, Streams(1).generator())
    found = task.performance(agent, levels, torch.Generator())
    for copy in range(K):
        for index in range(E):
            total, success = by_hand(agent, copy, levels[index], True, torch.Generator())
            assert float(found["return"][copy, index]) == pytest.approx(total, rel=1e-5)
            assert float(found["success"][copy, index]) == success
    assert 0 < found["success"].mean() < 1


def test_drawn_actions_give_the_same_distribution() -> None:
    episodes = 150
    task = walk_task(evaluation=EvaluationSettings(levels=4, episodes=episodes))
    agent, numbers = solvers(task), torch.Generator().manual_seed(0)
    # A level on which either end is likely.
    several = task.space.sample(40, Streams(0).generator())
    rough = walk_task(evaluation=EvaluationSettings(levels=4, episodes=20)).performance(
        agent, several, torch.Generator()
    )["success"][0]
    level = several[int((rough - 0.5).abs().argmin())]
    found = task.performance(agent, level.unsqueeze(0), torch.Generator())[0, 0]
    played = [by_hand(agent, 0, level, False, numbers) for _ in range(episodes)]
    totals, successes = torch.tensor(played).unbind(-1)
    error = (2 * totals.var() / episodes).sqrt()
    assert abs(float(found["return"] - totals.mean())) < 4 * error
    assert 0.1 < float(successes.mean()) < 0.9
    assert abs(float(found["success"] - successes.mean())) < 4 * (0.5 / episodes) ** 0.5
