"""The meta-environment against a plain loop that trains one Solver."""

from __future__ import annotations

import re
from itertools import product

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs

from proposer_rl.learning import PPO, DivergedError, PPOSettings, SolverSettings
from proposer_rl.meta import rewards
from proposer_rl.meta.actions import Mixture, ProblemChoices
from proposer_rl.meta.env import SolverTrainingEnv, SolverView
from proposer_rl.settings import ArgumentError
from proposer_rl.streams import Streams
from proposer_rl.tasks.mazes.task import UNetSettings
from tests.tiny import evaluate, tiny_task

K, P, C, E, L = 3, 4, 2, 6, 3
# What an episode is does not hang on how much is computed in it; steps are large, to be seen.
TASK = tiny_task(
    network=UNetSettings(channels=[8], groups=4),
    solver=SolverSettings(batch_size=P, ppo=PPOSettings(horizon=8, epochs=1, learning_rate=2e-2)),
)
SPACE = TASK.space


def learners(copies: int) -> PPO:
    """As many copies of one Solver, the same in every call."""
    return TASK.learner([Streams(0, "solver")] * copies)


def meta_env(
    reward: rewards.Reward = rewards.performance_gain, *, probe_levels: int = C, **options
) -> SolverTrainingEnv:
    view = SolverView(TASK, validation_levels=E, probe_levels=probe_levels)
    parts = {"actions": ProblemChoices(SPACE), "meta_episode_length": L}
    return SolverTrainingEnv(learners(K), view=view, reward=reward, **{**parts, **options})


def mixture() -> Mixture:
    return Mixture(SPACE, torch.eye(SPACE.size))


def play(env: SolverTrainingEnv, actions: torch.Tensor) -> TensorDict:
    """Step through actions [T, K, ...]; the transitions [K, T]."""
    state, steps = env.reset(), []
    for action in actions:
        step, state = env.step_and_maybe_reset(state.set("action", action))
        steps.append(step)
    return torch.stack(steps, 1)


def played(env: SolverTrainingEnv, seed: int = 4) -> TensorDict:
    """An episode of some actions, from a fresh Solver."""
    env.fork(learners(1).snapshot()[0], Streams(seed))
    return play(env, some_actions())


def some_actions() -> torch.Tensor:
    return torch.randint(SPACE.size, (L, K, P), generator=torch.Generator().manual_seed(1))


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"probe_levels": 0},
        {"actions": mixture()},
        {"meta_episode_length": 6, "action_repeat": 3},
    ],
)
def test_specs(options: dict) -> None:
    check_env_specs(meta_env(**options), break_when_any_done="both")


@pytest.mark.parametrize("episode", [0, 1])
def test_an_episode_is_a_plain_loop_over_one_solver(episode: int) -> None:
    """Also the second: it starts with the Solver that was forked, not with those of the first."""
    env, start, streams, actions = meta_env(), learners(1).snapshot(), Streams(9), some_actions()
    env.fork(start[0], streams)
    steps = [play(env, actions) for _ in range(episode + 1)][episode]
    validation = TASK.target.sample(E, streams.generator("validation"))
    for k in range(K):
        solver = learners(1)
        returns = [evaluate(solver.agent, validation)["return"].mean()]
        for step in range(L):
            place = (episode, step, k)
            levels = SPACE.generate(actions[step, k], streams.generator(*place, "levels"))
            solver.env.set_levels(levels[None])
            solver.update([streams.generator(*place, "actions")])
            returns.append(evaluate(solver.agent, validation)["return"].mean())
        gains = torch.stack(returns).diff()
        torch.testing.assert_close(steps["next", "reward"][k, :, 0], gains, rtol=1e-3, atol=1e-5)
        assert gains.abs().max() > 1e-3
        own = TASK.probe(solver.agent, env.view.probes)[0]
        torch.testing.assert_close(steps["next", "probes"][k, -1], own, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("reward", [rewards.performance_gain, rewards.log_success_gain])
def test_rewards_sum_to_the_total_gain_on_the_one_validation_batch(reward: rewards.Reward) -> None:
    env = meta_env(reward)
    steps = played(env)
    validation = TASK.target.sample(E, Streams(4).generator("validation"))
    assert (env.view.validation == validation).all()
    totals = {}
    for agent in (learners(K).agent, env.solvers.agent):
        reached = evaluate(agent, validation)
        totals[agent] = {
            "return": reached["return"].mean(1),
            "log_success": (reached["success"] + 0.001).log().mean(1),
        }
    before, after = totals.values()
    paid = "return" if reward is rewards.performance_gain else "log_success"
    gain = after[paid] - before[paid]
    torch.testing.assert_close(steps["next", "reward"].sum((1, 2)), gain, rtol=1e-4, atol=1e-6)
    for name in ("return", "log_success"):  # both are told, whatever is paid
        torch.testing.assert_close(steps[name][:, 0, 0], before[name])
        torch.testing.assert_close(steps["next", name][:, -1, 0], after[name])


@pytest.mark.parametrize("shape", [[], [K, 1], [K, P]])
def test_a_reward_of_another_shape_is_refused(shape: list[int]) -> None:
    message = rf"^reward: must be a number for each Solver, of shape \[{K}\], got shape "
    with pytest.raises(ArgumentError, match=message + re.escape(str(shape))):
        played(meta_env(lambda _: torch.zeros(shape)))


def test_all_replicas_start_as_the_forked_solver() -> None:
    env = meta_env()
    solver = learners(1)
    solver.update([torch.Generator().manual_seed(5)])
    env.fork(solver.snapshot()[0], Streams(2))
    state = env.reset()
    assert (state["probes"] == state["probes"][:1]).all()
    assert (state["return"] == state["return"][0]).all()
    assert (env.solvers.snapshot() == solver.snapshot()[[0] * K]).all()


def test_an_episode_that_was_broken_off_can_be_played_again() -> None:
    class Stop(Exception):
        """An interruption."""

    def stop() -> None:
        raise Stop

    env = meta_env()
    whole = played(env)
    for after in (1, L):
        calls = iter([*[lambda: None] * (after - 1), stop, *[lambda: None] * L])
        env.on_update = lambda _, calls=calls: next(calls)()
        with pytest.raises(Stop):
            played(env)
        assert (played(env) == whole).all()


@pytest.mark.parametrize("forked", [False, True])
def test_the_seed_decides_what_an_episode_draws(forked: bool) -> None:
    gains: list[torch.Tensor] = []
    walls: list[torch.Tensor] = []

    def noted(step: rewards.TrainingStep) -> torch.Tensor:
        played.append(step.levels.walls)
        return rewards.performance_gain(step)

    env, played = meta_env(noted), []
    for seed in (4, 4, 5):
        env.set_seed(seed)
        if forked:
            env.fork(learners(1).snapshot()[0], env.streams)
        gains.append(play(env, some_actions())["next", "reward"])
        walls.append(played[-1])
    for drawn in (gains, walls):
        assert drawn[0].equal(drawn[1]) and not drawn[0].equal(drawn[2])


def test_an_episode_ends_after_its_last_update_and_counts_what_was_proposed() -> None:
    env, actions = meta_env(), some_actions()
    steps = played(env)
    assert steps["next", "done"][:, -1].all() and not steps["next", "done"][:, :-1].any()
    # The Solvers stay as they were trained, also after the automatic reset.
    after = evaluate(env.solvers.agent, env.view.validation)["return"].mean(1)
    torch.testing.assert_close(after, steps["next", "return"][:, -1, 0])
    progress = torch.arange(L + 1) / L
    torch.testing.assert_close(steps["progress"][0, :, 0], progress[:-1])
    torch.testing.assert_close(steps["next", "progress"][0, :, 0], progress[1:])
    for k, step in product(range(K), range(L)):
        counts = actions[step, k].bincount(minlength=SPACE.size)
        assert torch.equal(steps["next", "proposed"][k, step], counts)


def test_a_reward_is_shown_the_whole_step() -> None:
    seen = []

    def reward(step: rewards.TrainingStep) -> torch.Tensor:
        success = evaluate(step.agent, TASK.target.sample(E, Streams(1).generator()))["success"]
        seen.append(step)
        return success.mean(1)

    env = meta_env(reward)
    paid = played(env)["next", "reward"][:, -1, 0]
    for step, following in zip(seen, [*seen[1:], None], strict=True):
        assert torch.equal(step.levels.walls, step.rollout["planes"][:, :, 0, 0].bool())
        assert step.before.batch_size == step.after.batch_size == (K, E)
        assert following is None or (step.after == following.before).all()
    levels = TASK.target.sample(E, Streams(1).generator())
    torch.testing.assert_close(paid, evaluate(env.solvers.agent, levels)["success"].mean(1))


@pytest.mark.parametrize("reward", [rewards.performance_gain, rewards.task_difficulty])
def test_an_action_that_holds_is_the_same_action_repeated(reward: rewards.Reward) -> None:
    """Its rewards add up, and every update is reported."""
    actions, calls, episodes = some_actions()[:2], [], []
    options = {"reward": reward, "meta_episode_length": 4, "on_update": calls.append}
    for repeat, script in ((2, actions), (1, actions.repeat_interleave(2, 0))):
        env = meta_env(action_repeat=repeat, **options)
        env.fork(learners(1).snapshot()[0], Streams(3))
        episodes.append(play(env, script))
    few, many = episodes
    assert few.batch_size == (K, 2) and calls == [1, 2, 3, 4] * 2
    for entry in ("probes", "return", "log_success", "done", "progress"):
        assert torch.equal(few["next", entry], many["next", entry][:, 1::2])
    for entry in ("reward", "proposed"):
        pairs = many["next", entry].unflatten(1, (2, 2)).sum(2)
        torch.testing.assert_close(few["next", entry], pairs)
    if reward is rewards.task_difficulty:
        assert ((many["next", "reward"] >= 0) & (many["next", "reward"] <= 1)).all()
        assert few["next", "reward"].std() > 0


def test_a_share_of_the_replicas_is_those_replicas() -> None:
    """A worker's environment, for example, has replicas 1 and 2 only."""
    whole, share = meta_env(), meta_env(first_replica=1)
    every, last = played(whole), played(share)
    shifted = torch.cat([some_actions()[:, 1:], some_actions()[:, :1]], 1)
    share.fork(learners(1).snapshot()[0], Streams(4))
    own = play(share, shifted)[: K - 1]
    torch.testing.assert_close(own["next", "reward"], every[1:]["next", "reward"])
    assert not torch.equal(last["next", "reward"], every["next", "reward"])


def test_a_replica_that_diverges_has_its_number_among_all() -> None:
    share = meta_env(first_replica=4)
    first, second = some_actions()[:2]
    _, state = share.step_and_maybe_reset(share.reset().set("action", first))
    next(share.solvers.agent.parameters()).data[1] = torch.nan
    place = "^update 1 of the episode of the Solver's copies: copy 5: "
    with pytest.raises(DivergedError, match=place):
        share.step(state.set("action", second))


@pytest.mark.parametrize(("length", "repeat"), [(0, 1), (L, 2), (L, 0)])
def test_lengths_that_make_no_sense_are_refused(length: int, repeat: int) -> None:
    message = f"action_repeat={repeat} must divide meta_episode_length={length}"
    with pytest.raises(ValueError, match=message):
        meta_env(meta_episode_length=length, action_repeat=repeat)
