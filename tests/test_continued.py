"""Episodes that go on across rollouts: each level's outcome against playing it alone."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase

from proposer_rl import curricula as c
from proposer_rl.curricula.contract import outcome_of_episodes
from proposer_rl.experiment.continued import ContinuedLevels
from proposer_rl.experiment.loop import SideBySide
from proposer_rl.learning import PPOSettings, RolloutCollector, SolverSettings
from proposer_rl.streams import Streams
from proposer_rl.tasks.gymnasium.batched_env import plays
from proposer_rl.tasks.gymnasium.environment import SuccessSettings
from proposer_rl.tasks.gymnasium.player import LevelPlayer
from tests.same_run import assert_same_run
from tests.tasks.gymnasium.toys import LIMIT, PARAMETERS, walk_task
from tests.test_experiment import experiment
from tests.tiny import tiny_view_task

K, P, T = 2, 3, 4
SEEDS = list(range(K))


def continued_task(success: Any = None, **changed: Any) -> Any:
    numbers: dict[str, Any] = {"horizon": T, "epochs": 2, "minibatches": 2, "learning_rate": 3e-3}
    ppo = PPOSettings(continue_episodes=True, anneal_updates=30, **{**numbers, **changed})
    rule = {} if success is None else {"success": success}
    return walk_task(solver=SolverSettings(batch_size=P, ppo=ppo), **rule)


TASK = continued_task()


class Kept(c.Curriculum):
    """Levels of the target; remembers what it has proposed and observed."""

    def __init__(self) -> None:
        self.proposed: list[Any] = []
        self.observed: list[tuple[c.Batch, TensorDictBase]] = []

    def propose(self, student: c.Student, count: int, rng: Streams) -> c.Batch:
        levels = TASK.target.sample(count, rng.generator("levels"))
        self.proposed.append(levels)
        notes = {"number": torch.full((count,), len(self.proposed)), "place": torch.arange(count)}
        return c.Batch(levels, TensorDict(notes, [count]))

    def observe(self, student: c.Student, batch: c.Batch, outcome: TensorDictBase) -> None:
        self.observed.append((batch, outcome))


def played(level: TensorDictBase, actions: list[int]) -> tuple[float, bool]:
    """Return and success of an episode on a level [1], by the environment alone."""
    (play,) = plays(level, PARAMETERS)
    player = LevelPlayer(TASK._make, PARAMETERS, play)
    player.reset()
    total = 0.0
    for number, action in enumerate(actions, 1):
        _, reward, terminated, truncated, _ = player.step(action + 1)
        total += reward
        assert (terminated or truncated) == (number == len(actions))
    return total, terminated


def test_each_episode_is_credited_to_its_level() -> None:
    """Replica by replica and environment by environment, with queues that are plain lists."""
    learner = TASK.learner([Streams(seed) for seed in SEEDS])
    curricula, updates = [Kept() for _ in SEEDS], 14
    sides, like = SideBySide(TASK, learner, curricula), TASK.evaluated_on["target"][0]
    levels = ContinuedLevels(curricula, sides.students, learner, like)
    rollouts, sizes = [], []
    for update in range(updates):
        result, credits = levels.update([Streams(seed, update) for seed in SEEDS])
        sides.observe(credits)
        rollouts.append(result.rollout)
        sizes += [len(curriculum.proposed[-1]) for curriculum in curricula]
    whole: Any = torch.cat(rollouts, 2)
    expected: dict[tuple[int, int], tuple[float, bool, int]] = {}  # by replica and level's seed
    for k in range(K):
        queue: list[TensorDictBase] = []
        now: list[Any] = [None] * P
        since = [0] * P
        for t in range(updates * T):
            if t % T == 0:  # a proposal; of what is left over the newest P stay
                proposed = curricula[k].proposed[t // T]
                queue = queue[-P:] + [level.unsqueeze(0) for level in proposed]
            if t == 0:
                now = [queue.pop(0) for _ in range(P)]
            for p in range(P):
                if whole["next", "done"][k, p, t]:
                    actions = whole["action"][k, p, since[p] : t + 1].tolist()
                    seed = int(now[p]["seed"])
                    expected.setdefault((k, seed), (*played(now[p], actions), len(actions)))
                    now[p], since[p] = queue.pop(0) if queue else now[p], t + 1
    seen: Counter[tuple[int, int]] = Counter()
    for k, curriculum in enumerate(curricula):
        for batch, outcome in curriculum.observed:
            for m in range(len(batch)):
                key = k, int(batch.levels["seed"][m])
                seen[key] += 1
                total, success, steps = expected[key]
                assert float(outcome["return"][m]) == pytest.approx(total, abs=1e-5)
                assert float(outcome["success"][m]) == success
                assert int(outcome["steps"][m]) == steps
            places = batch.notes["place"]
            assert (places.diff() > 0).all() and (batch.notes["number"].diff() == 0).all()
    assert max(seen.values()) == 1
    assert len(seen) > 0.6 * len(expected)  # the rest is outstanding, or left out
    lengths = [steps for _, _, steps in expected.values()]
    assert max(lengths) == LIMIT > T > min(lengths)
    assert len({*sizes}) > 2  # as many levels as episodes end


def test_what_an_episode_gives_does_not_depend_on_those_beside_it() -> None:
    """Episodes of several lengths are filled up to one rollout; what fills them counts nowhere."""
    learner = TASK.learner([Streams(0)])
    student = c.TaskStudent(TASK, learner)
    levels, draws = TASK.evaluated_on["target"][: 2 * P], torch.Generator()
    whole: Any = torch.cat([student.play(some, draws) for some in levels.split(P)])
    ends = whole["next", "done"].squeeze(-1).long().argmax(-1) + 1
    episodes: list[Any] = [whole[place, :end].clone() for place, end in enumerate(ends.tolist())]
    assert len({*ends.tolist()}) > 1
    for episode in episodes:
        episode["is_step"] = torch.ones(len(episode), dtype=torch.bool)
    together = outcome_of_episodes(episodes)
    alone = [outcome_of_episodes([episode]) for episode in episodes]
    assert together["steps"].tolist() == ends.tolist()
    norms = [student.policy_gradient_norms(outcome["rollout"]) for outcome in alone]
    found_norms = student.policy_gradient_norms(together["rollout"])
    torch.testing.assert_close(found_norms, torch.cat(norms), rtol=1e-4, atol=1e-5)


def test_a_memory_goes_on_with_its_episode() -> None:
    """Two rollouts are one of twice the length."""
    halves, whole = (
        tiny_view_task(
            solver=SolverSettings(
                batch_size=P, ppo=PPOSettings(horizon=horizon, continue_episodes=True)
            )
        ).learner([Streams(0)])
        for horizon in (T, 2 * T)
    )
    task = tiny_view_task()
    levels = task.target.sample(P, torch.Generator().manual_seed(0)).unsqueeze(0)
    for learner in (halves, whole):
        learner.env.set_levels(levels)
    generators = [torch.Generator().manual_seed(0)], [torch.Generator().manual_seed(0)]
    first, second = (halves.collect(generators[0]) for _ in range(2))
    expected = whole.collect(generators[1])
    found: Any = torch.cat([first, second], 2)
    for key in ("action", "state_value", ("next", "recurrent_state_h"), "view"):
        torch.testing.assert_close(found[key], expected[key])


def test_others_watch_whole_episodes_elsewhere() -> None:
    """What a score plays leaves the episodes of the training where they are."""
    learner = TASK.learner([Streams(seed) for seed in SEEDS])
    student = c.TaskStudent(TASK, learner, 1)
    assert isinstance(learner.collector, RolloutCollector)
    levels = TASK.evaluated_on["target"]
    generators = [torch.Generator().manual_seed(seed) for seed in SEEDS]
    learner.env.set_levels(torch.stack([levels[:P]] * K))
    before = learner.collect(generators)
    rollout = student.play(levels[:2], generators[0])
    assert rollout.shape == (2, max(LIMIT, T)) and rollout["next", "done"].any(1).all()
    after = learner.collect(generators)
    going_on = ~before["next", "done"][:, :, -1, 0]
    assert torch.equal(
        after["observation"][:, :, 0][going_on], before["next", "observation"][:, :, -1][going_on]
    )


def walking() -> Any:
    """A success may be of a step before the checkpoint."""
    far = SuccessSettings(kind="info", key="far", once=True)
    return continued_task(far, normalize_observations=True, normalize_rewards=True)


def remembering() -> Any:
    ppo = PPOSettings(
        horizon=T, epochs=2, minibatches=3, continue_episodes=True, normalize_rewards=True
    )
    return tiny_view_task(solver=SolverSettings(batch_size=P, ppo=ppo))


def run(folder: Path, updates: int, task: Any) -> None:
    rule = c.ReplayRule(prioritization="rank", temperature=0.3, best=None, staleness=0.1)
    scorer = c.Scorer("positive_value_loss", "episodes")
    curricula = [c.ReplayCurriculum(task.space, scorer, rule, capacity=8) for _ in SEEDS]
    lengths = {"updates": updates, "cycle_length": 5, "evaluate_every": 5, "threshold": 0.8}
    experiment(folder, *SEEDS, curriculum=curricula, task=task, **lengths).run()


@pytest.mark.parametrize("task", [walking, pytest.param(remembering, marks=pytest.mark.slow)])
def test_a_resumed_run_goes_on_in_the_middle_of_its_episodes(task: Any, tmp_path: Path) -> None:
    for updates in (5, 9):
        run(tmp_path / "resumed", updates, task())
    run(tmp_path / "whole", 9, task())
    assert_same_run(tmp_path / "resumed", tmp_path / "whole")


def test_pictures_show_an_agent_that_the_policy_sees(
    train: Callable[..., int], tmp_path: Path
) -> None:
    """What a policy sees is left out of episodes, but for where it was, step by step."""
    settings = ["task.maze.observe_agent=true", "solver.ppo.continue_episodes=true"]
    method = ["+method=plr", "+scale=smoke", "compute.progress=false", *settings]
    assert train(*method, f"hydra.run.dir={tmp_path}") == 0
    *_, last = (tmp_path / "curriculum.jsonl").read_text(encoding="utf-8").splitlines()
    levels = json.loads(last)["levels"]
    assert levels
    for level in levels:
        for here, there in pairwise(level["path"]):
            assert sum(abs(a - b) for a, b in zip(here, there, strict=True)) <= 1
