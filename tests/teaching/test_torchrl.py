"""Levels in TorchRL's collectors: each episode is one on the level that it began on."""

from __future__ import annotations

import pickle
from functools import partial
from typing import Any

import gymnasium
import pytest
import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from tensordict import TensorDict, lazy_stack
from torchrl.collectors import Collector, MultiSyncCollector
from torchrl.collectors.utils import split_trajectories
from torchrl.data import Composite, Unbounded
from torchrl.envs import (
    Compose,
    ExcludeTransform,
    FrameSkipTransform,
    GymWrapper,
    ParallelEnv,
    RewardScaling,
    SerialEnv,
    StepCounter,
    TransformedEnv,
)
from torchrl.envs.utils import RandomPolicy, check_env_specs

import proposer_rl as prl
from proposer_rl.settings import ArgumentError
from tests.host_reads import CountedReads
from tests.teaching.counting import LevelsEnv, check, counted, length, seen, set_level

LEVELS = 4


def taught(teacher: Any, count: int | None = LEVELS, **how: Any) -> TransformedEnv:
    return TransformedEnv(LevelsEnv(count), prl.LevelTransform(teacher, set_level, **how))


def collecting(env: Any, steps: int, **how: Any) -> Collector:
    policy, frames = RandomPolicy(LevelsEnv().action_spec), LEVELS * steps
    return Collector(env, policy, frames_per_batch=frames, total_frames=-1, **how)


def collected(env: Any, steps: int, batches: int, **how: Any) -> list[Any]:
    collector = collecting(env, steps, **how)
    rollouts = [collector.rollout().clone() for _ in range(batches)]
    collector.shutdown()
    return rollouts


@pytest.mark.parametrize("count", [LEVELS, None])
def test_it_keeps_what_torchrl_asks_of_environments(count: int | None) -> None:
    check_env_specs(taught(counted(), count), break_when_any_done="both")


@pytest.mark.parametrize("afresh", [True, False])
@pytest.mark.parametrize("steps", [3, 8])
def test_an_episode_goes_to_the_level_that_it_began_on(afresh: bool, steps: int) -> None:
    teacher = counted("success", block=3)
    rollouts = collected(taught(teacher), steps, 5, reset_at_each_iter=afresh)
    came = seen(teacher)
    check(came)
    ended = sum(int(rollout["next", "done"].sum()) for rollout in rollouts)
    assert len(came) == ended > 4
    for rollout in rollouts:  # the reward of a step is the number of its level
        ids = rollout["level_id"].squeeze(-1)
        assert (rollout["next", "reward"].squeeze(-1) == ids).all()
        assert (rollout["next", "level_id"] == rollout["level_id"]).all()


@pytest.mark.parametrize("how", ["alternating", "one after another", "split", "lazy"])
def test_an_episode_is_put_together_from_whichever_rows_it_is_in(how: str) -> None:
    """As of several workers that come by turns, or whose time is one line; or of trajectories.

    Whole episodes, also those that began in an earlier rollout.
    """
    teacher = counted("rollout", "success", block=3)
    workers = [collecting(taught(teacher, tell=False), 3) for _ in range(2)]
    for _ in range(6):
        rollouts = [worker.rollout().clone() for worker in workers]
        if how == "split":
            rollouts = [split_trajectories(rollout) for rollout in rollouts]
        if how == "lazy":
            rollouts = [lazy_stack([*rollout.unbind(0)]) for rollout in rollouts]
        for rollout in [torch.cat(rollouts, 1)] if how == "one after another" else rollouts:
            teacher.observe(rollout)
    for worker in workers:
        worker.shutdown()
    check(teacher.curriculum.seen)
    assert len(teacher.curriculum.seen) > 16
    for number, rollout in teacher.curriculum.rollouts.items():
        steps = int(length(number))
        assert rollout["observation"].flatten()[:steps].tolist() == list(range(steps))
        assert rollout["is_step"].sum() == steps
        assert rollout["next", "done"].flatten().nonzero().tolist() == [[steps - 1]]


def test_rollouts_may_be_cut_by_a_transform_behind_it() -> None:
    """Every call resets all environments, also those whose episodes have been observed."""
    teacher = counted("rollout", "success", block=3)
    env = taught(teacher, tell=False).append_transform(StepCounter(2))
    for _ in range(4):
        teacher.observe(env.rollout(10))
    came = seen(teacher)
    assert len(came) == 4 * LEVELS
    assert all(total == 2 * number for number, (total, _) in came.items())


@pytest.mark.parametrize("tell", [True, False])
def test_transforms_that_step_by_themselves_may_stand_behind_it(tell: bool) -> None:
    """They step through clones of those before them."""
    teacher = counted("success", *([] if tell else ["rollout"]), block=3)
    env = taught(teacher, tell=tell).append_transform(FrameSkipTransform(2))
    rollout = env.rollout(16, break_when_any_done=False)
    if not tell:
        teacher.observe(rollout)
    came = seen(teacher)
    if tell:
        check(came)
    assert len(came) == int(rollout["next", "done"].sum()) > LEVELS


def test_a_clone_has_episodes_of_its_own_in_another_environment() -> None:
    teacher = counted("success", block=3)
    env = taught(teacher)
    state = env.reset()
    TransformedEnv(LevelsEnv(LEVELS), env.transform.clone()).rollout(2)
    env.rollout(16, break_when_any_done=False, auto_reset=False, tensordict=state)
    came = seen(teacher)
    check(came)
    assert {*range(LEVELS)} < came.keys()


def test_a_transform_that_ends_episodes_may_stand_behind_it() -> None:
    teacher = counted(block=3)
    transforms = prl.LevelTransform(teacher, set_level), StepCounter(2), RewardScaling(0.0, 0.1)
    rollouts = collected(TransformedEnv(LevelsEnv(), Compose(*transforms)), 4, 3)
    came = seen(teacher)
    assert len(came) >= 8
    for number, (total, _) in came.items():
        assert total == 2 * number
    assert rollouts[0]["level_id"].unique().numel() > LEVELS


def test_environments_in_other_processes_have_one_teacher(monkeypatch: pytest.MonkeyPatch) -> None:
    # What TorchRL asks: forks of this process import nothing.
    monkeypatch.setattr(torch.multiprocessing, "get_start_method", lambda **_: "fork")
    teacher = counted("success", block=3)
    # As where the process is none that forked from this one.
    make = partial(taught, pickle.loads(pickle.dumps(teacher.client())), None)
    env = ParallelEnv(2, make)
    rollout = env.rollout(12, break_when_any_done=False)
    env.close()
    collector = MultiSyncCollector(
        [partial(SerialEnv, 2, make)] * 2,
        RandomPolicy(SerialEnv(2, make).action_spec),
        frames_per_batch=48,
        total_frames=48,
    )
    rollouts = [rollout, *(each.clone() for each in collector)]
    collector.shutdown()
    came = seen(teacher)
    check(came)
    begun = [set(each["level_id"].unique().tolist()) for each in rollouts]
    assert len(came) > 6 and not begun[0] & begun[1]


BETWEEN = [lambda env: env, lambda env: TransformedEnv(env, StepCounter())]


@pytest.mark.filterwarnings("ignore:Nested TransformedEnvs")
@pytest.mark.parametrize("between", BETWEEN)
@pytest.mark.parametrize("unwrapped", [True, False])
@pytest.mark.parametrize("same", [True, False])
def test_an_environment_has_one_teacher(same: bool, unwrapped: bool, between: Any) -> None:
    """As where a notebook's cell is run twice; what takes the place of the first goes on alone."""
    teacher = counted()
    first = taught(teacher)
    transform = prl.LevelTransform(teacher if same else counted(), set_level)
    twice = TransformedEnv(between(first), transform, auto_unwrap=unwrapped)
    with pytest.raises(ArgumentError, match=r"^env: has another LevelTransform"):
        twice.rollout(3)
    again = taught(counted(), count=None)
    anew = TransformedEnv(again.base_env, prl.LevelTransform(other := counted(), set_level))
    again.rollout(3)
    anew.rollout(30, break_when_any_done=False)
    check(seen(other))
    with pytest.raises(ArgumentError, match=r"^env: has another LevelTransform"):
        again.rollout(3)


@pytest.mark.filterwarnings("ignore")
def test_environments_that_reset_themselves_are_refused() -> None:
    """They would begin each episode on the level of the one before."""

    def play(mode: AutoresetMode) -> None:
        vector = SyncVectorEnv([partial(gymnasium.make, "CartPole-v1")] * 2, autoreset_mode=mode)
        transform = prl.LevelTransform(counted(), lambda env, levels: None)
        TransformedEnv(GymWrapper(vector), transform).rollout(3)

    play(AutoresetMode.DISABLED)
    with pytest.raises(ArgumentError, match="env: resets itself at the end of an ep"):
        play(AutoresetMode.SAME_STEP)


class Several(LevelsEnv):
    """Two rewards, of which one is that of the level: of agents, or of objectives."""

    def __init__(self, key: Any, shape: tuple[int, ...]) -> None:
        super().__init__(3)
        self.key, self.shaped = key, (3, *shape)
        spec = Unbounded(self.shaped)
        agents = Composite(reward=spec, shape=(3, 2))
        self.reward_spec = spec if key == "reward" else Composite(agents=agents, shape=(3,))

    def _step(self, tensordict: Any) -> Any:
        after = super()._step(tensordict)
        rewards = torch.zeros(self.shaped)
        rewards[:, 0] = after.pop("reward").reshape(3, *[1] * (len(self.shaped) - 2))
        agents = TensorDict({"reward": rewards}, [3, 2]) if self.key != "reward" else None
        return after.set("reward", rewards) if agents is None else after.set("agents", agents)


AGENTS, OBJECTIVES = (("agents", "reward"), (2, 1)), ("reward", (2,))


@pytest.mark.parametrize("kind", [SerialEnv, ParallelEnv])
def test_environments_that_set_level_cannot_reach_are_refused(kind: Any) -> None:
    teacher = counted()
    env = TransformedEnv(kind(2, LevelsEnv), prl.LevelTransform(teacher, set_level))
    with pytest.raises(ArgumentError, match=f"env: set_level cannot reach .* {kind.__name__}"):
        env.reset()
    assert teacher.ask()[0] == 0  # no level is lost


@pytest.mark.parametrize("rewards", [AGENTS, OBJECTIVES])
def test_a_function_makes_one_reward_of_several(rewards: Any) -> None:
    """One for all would be broadcast, and several are too many; by torch, which names both."""
    teacher = counted("success")

    def play(reward: Any) -> None:
        transform = prl.LevelTransform(teacher, set_level, reward=reward)
        TransformedEnv(Several(*rewards), transform).rollout(12, break_when_any_done=False)

    for wrong in (rewards[0], lambda after: torch.ones(1)):
        with pytest.raises(RuntimeError, match=r"shape '\[3\]' is invalid for input of size"):
            play(wrong)
    play(lambda after: after[rewards[0]].flatten(1).sum(-1, keepdim=True))
    came = seen(teacher)
    check(came)
    assert len(came) > 3


@pytest.mark.parametrize("once", [True, False])
def test_a_success_may_be_of_any_step(once: bool) -> None:
    """It is there in the first step of odd levels, and in the last one of every fourth."""

    def won(after: Any) -> Any:
        level = after["reward"]  # see LevelsEnv
        return ((after["observation"] == 1) & (level % 2 == 1)) | (after["done"] & (level % 4 == 0))

    teacher = counted("success")
    taught(teacher, success=won, once=once).rollout(16, break_when_any_done=False)
    came = seen(teacher)
    assert len(came) > 8
    for number, (_, success) in came.items():
        assert success == (number % 4 == 0 or (once and number % 2 == 1)), number


def test_mazes_say_what_is_a_success() -> None:
    """The goal is to the right: the first episode gets there, the second one does not."""
    teacher: Any = counted("success")
    env = prl.MazeEnv(prl.Level.from_text("S.G"), max_steps=3)
    env = TransformedEnv(env, prl.LevelTransform(teacher, lambda env, level: None))
    for action in (3, 2):
        state = env.reset()
        while not state["done"]:
            state = env.step(state.set("action", torch.tensor(action)))["next"]
    teacher.propose(1)  # takes in what was told
    assert [success for _, success in teacher.curriculum.seen.values()] == [1.0, 0.0]


def test_results_that_a_curriculum_requires_are_asked_for() -> None:
    def told(**how: Any) -> set[float]:
        teacher = counted("success")
        silent = ExcludeTransform("success")
        transform = Compose(silent, prl.LevelTransform(teacher, set_level, **how))
        TransformedEnv(LevelsEnv(), transform).rollout(8, break_when_any_done=False)
        return {success for _, success in seen(teacher).values()}

    with pytest.raises(ArgumentError, match=r'success: missing: .*success="terminated" to Lev'):
        told()
    with pytest.raises(ArgumentError, match=r"rollout: missing: .*LevelTransform.tell=False"):
        taught(counted("rollout")).rollout(9, break_when_any_done=False)
    assert told(success="terminated") == {1.0}
    assert told(success=lambda after: ~after["terminated"]) == {0.0}


def test_the_end_of_episodes_waits_for_the_device_once() -> None:
    teacher = counted()
    env = taught(teacher)
    env.reset()
    ended = torch.tensor([True, False, True, False])
    env.transform._now.knows = True
    with CountedReads() as reads:
        env.transform._end(ended)
        env.transform._end(torch.zeros_like(ended))
    assert reads.count == 2
