"""The batch is many environments of Gymnasium, each by itself; successes are counted as asked."""

from __future__ import annotations

import signal
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from torchrl.envs.utils import check_env_specs

from proposer_rl.runs.process import StopSignals
from proposer_rl.streams import Streams
from proposer_rl.tasks.gymnasium.batched_env import GymnasiumEnv
from proposer_rl.tasks.gymnasium.environment import SuccessSettings
from proposer_rl.tasks.gymnasium.player import GymLevel, LevelPlayer, MakeEnvironment
from proposer_rl.tasks.parameters import ParameterSpace
from tests.tasks.gymnasium import toys
from tests.tasks.gymnasium.odd import Line, odd
from tests.tasks.gymnasium.toys import LIMIT, PARAMETERS, WALK, set_wind

K, P, T = 2, 3, 20
SPACE = ParameterSpace({name: settings.space_bins() for name, settings in PARAMETERS.items()})
LEVELS = SPACE.sample(K * P, Streams(0).generator()).reshape(K, P)


def make(**more: Any) -> GymnasiumEnv:
    rule = SuccessSettings(kind="terminated")
    return GymnasiumEnv(LEVELS, MakeEnvironment(WALK), PARAMETERS, success=rule, **more)


def by_hand(level: Any, actions: list[int]) -> list[tuple[Any, float, bool, bool]]:
    """What a plain loop over Gymnasium's own environment sees: state before, reward, ends."""
    env: Any = gymnasium.make(WALK, width=level["width"].item())
    env.unwrapped.engine.speed = level["speed"].item()
    set_wind(env.unwrapped, level["wind"].item())
    start = {"seed": level["seed"].item(), "options": {"start": level["begin"].item()}}
    seen, _ = env.reset(**start)
    rows = []
    for action in actions:
        after, reward, terminated, truncated, _ = env.step(action + 1)
        rows.append((seen, reward, terminated, truncated))
        seen = env.reset(**start)[0] if terminated or truncated else after
    return rows


@pytest.mark.parametrize("vectorization", ["sync", "async"])
def test_it_is_gymnasium_s_environments_side_by_side(vectorization: Any) -> None:
    env = make(vectorization=vectorization)
    rollout = env.rollout(T, break_when_any_done=False)
    env.close()
    assert rollout.batch_size == (K, P, T)
    ends = 0
    for k in range(K):
        for p in range(P):
            ours = rollout[k, p]
            rows = by_hand(LEVELS[k, p], ours["action"].tolist())
            states, rewards, terminated, truncated = zip(*rows, strict=True)
            np.testing.assert_allclose(ours["observation"], np.stack(states), rtol=1e-6)
            np.testing.assert_allclose(ours["next", "reward"].squeeze(-1), rewards, rtol=1e-6)
            assert ours["next", "terminated"].squeeze(-1).tolist() == list(terminated)
            assert ours["next", "truncated"].squeeze(-1).tolist() == list(truncated)
            assert ours["next", "success"].squeeze(-1).tolist() == list(terminated)
            ends += sum(terminated) + sum(truncated)
    assert ends > K * P  # episodes began again


def test_its_processes_end_when_a_run_does_and_leave_its_signals_alone() -> None:
    with StopSignals():
        before = signal.getsignal(signal.SIGTERM)
        env: Any = make(vectorization="async")
        env.reset()
        assert signal.getsignal(signal.SIGTERM) is before is not signal.SIG_DFL
        for process in env._vector.processes:
            process.terminate()
            process.join(60)
            assert process.exitcode == -signal.SIGTERM


def line(**members: Any) -> GymnasiumEnv:
    """One line of this kind in a process of its own."""
    levels = ParameterSpace({}).sample(1, Streams(0).generator())
    rule = SuccessSettings(kind="terminated")
    make = MakeEnvironment(odd(**members))
    return GymnasiumEnv(levels, make, {}, success=rule, vectorization="async")


def locked_step(self: Any, action: Any) -> Any:
    with toys.LOCK:
        return Line.step(self, action)


def test_locks_that_are_held_while_its_processes_start_are_free_in_them() -> None:
    """A fork of this process has them as they are, and waits forever: python/cpython#84559."""
    with toys.LOCK:
        env = line(step=locked_step)
        assert env.rollout(3).shape == (1, 3)
    env.close()


def test_its_specs_hold() -> None:
    check_env_specs(make())


def test_levels_are_taken_up_at_the_next_reset() -> None:
    env = make()
    env.reset()
    env.set_levels(SPACE.sample(K * P, Streams(1).generator()).reshape(K, P))
    after = env.rollout(3, auto_reset=True)["observation"]
    env.set_levels(LEVELS)
    torch.testing.assert_close(env.reset()["observation"], make().reset()["observation"])
    assert not torch.equal(after[:, :, 0], env.reset()["observation"])


STEPS = [  # ended by the environment, by the time limit, by both, cut off before
    (True, False, True, 3.0, {"won": 1}),
    (False, True, False, 5.0, {"won": 0}),
    (True, True, False, 1.0, {"won": 1, "deep": {"er": True}}),
    (False, True, True, 9.0, {}),
]


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({"kind": "terminated"}, [True, False, True, False]),
        ({"kind": "survived"}, [False, True, False, False]),
        ({"kind": "return", "least": 3.0}, [True, True, False, True]),
        ({"kind": "info", "key": "won", "optional": True}, [True, False, True, False]),
        ({"kind": "info", "key": "deep.er", "optional": True}, [False, False, True, False]),
    ],
)
def test_successes(settings: Any, expected: list[bool]) -> None:
    assert [SuccessSettings(**settings)(*step) for step in STEPS] == expected


@pytest.mark.parametrize("reward", [0.1, np.float32(0.7), -0.1])
def test_a_return_is_reached_up_to_rounding(reward: Any) -> None:
    rule = SuccessSettings(kind="return", least=round(10 * float(reward), 3))
    env = odd(step=lambda self, a: (self.seen(), reward, False, False, {}))
    player = LevelPlayer(MakeEnvironment(env, max_steps=10), {}, GymLevel({}, 0), rule)
    player.reset()
    assert [player.step(0)[4] for _ in range(10)] == [*[{}] * 9, {"success": True}]
    assert not rule(True, False, True, rule.least - 1e-4, {})  # type: ignore[operator]


@pytest.mark.parametrize(("kind", "needed"), [("return", "least"), ("info", "key")])
def test_success_has_what_its_kind_needs(kind: Any, needed: str) -> None:
    with pytest.raises(ValueError, match=f"{needed}: missing"):
        SuccessSettings(kind=kind)


RULES = [
    (SuccessSettings(kind="info", key="far", once=True), lambda far, rewards: any(far)),
    (SuccessSettings(kind="info", key="far"), lambda far, rewards: far[-1]),
    (SuccessSettings(kind="return", least=3.0), lambda far, rewards: sum(rewards) >= 3.0),
]


@pytest.mark.parametrize(("rule", "expected"), RULES)
def test_a_success_is_of_one_episode(rule: SuccessSettings, expected: Any) -> None:
    """Who has been far on the left may be back at the end; returns begin anew."""
    env = GymnasiumEnv(LEVELS, MakeEnvironment(WALK), PARAMETERS, success=rule)
    rollout = env.rollout(10 * LIMIT, break_when_any_done=False)
    found, last_alone = set(), set()
    for row in rollout.reshape(K * P, -1):
        far: list[bool] = []
        rewards: list[float] = []
        for step in row["next"]:
            far.append(bool(step["observation"][0] < -1))
            rewards.append(step["reward"].item())
            over = bool(step["done"])
            assert step["success"].item() == (over and expected(far, rewards))
            if over:
                found.add(step["success"].item())
                last_alone.add(any(far) and not far[-1])
                far, rewards = [], []
    assert found == last_alone == {True, False}
