"""The meta-environment against a plain loop that trains one Solver."""

from __future__ import annotations

import copy

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs

from proposer_rl.learning.divergence import DivergedError
from proposer_rl.learning.ppo import PPO, PPOSettings
from proposer_rl.mazes import Level, MazeEnv, SpecificationSpace, planes
from proposer_rl.mazes.evaluation import ExactEvaluator
from proposer_rl.meta.actions import Mixture, ProblemChoices
from proposer_rl.meta.env import ReplayError, SolverTrainingEnv
from proposer_rl.meta.rewards import Reward, TrainingStep, performance_gain, task_difficulty
from proposer_rl.meta.view import Measure, SolverView, episode_return, log_success
from proposer_rl.models import Population, UNet, cell_logits, map_actor_critic
from proposer_rl.streams import Streams

K, P, C, E, L = 3, 4, 2, 6, 5
SPACE = SpecificationSpace([0.0, 0.2], [2, 4], height=5, width=5)
EVALUATE = ExactEvaluator(max_steps=8)


def target(count: int, generator: torch.Generator) -> Level:
    return SPACE.generate(torch.full((count,), 3), generator)


def generate(choices: torch.Tensor, generators: list[torch.Generator]) -> Level:
    return torch.stack([SPACE.generate(c, g) for c, g in zip(choices, generators, strict=True)])


def evaluate(solver, levels: Level, generator: torch.Generator) -> TensorDict:
    copies = levels.expand(solver.copies, *levels.batch_size)
    return EVALUATE(copies, cell_logits(solver, planes(copies)))


def probe(solver, levels: Level) -> torch.Tensor:
    drawn = planes(levels.expand(solver.copies, *levels.batch_size))
    return torch.cat([drawn, cell_logits(solver, drawn)], -3)


def solvers(copies: int, learning_rate: float = 3e-3) -> PPO:
    torch.manual_seed(0)
    population = Population(lambda: UNet(channels=(8, 8), groups=4), copies)
    env = MazeEnv(SPACE.sample((copies, P)), max_steps=8)
    settings = PPOSettings(horizon=8, epochs=2, learning_rate=learning_rate)
    return PPO(env, map_actor_critic(population), settings)


def view(probe_levels: int = C, measure: Measure = episode_return) -> SolverView:
    return SolverView(
        target=target,
        evaluate=evaluate,
        probe=probe,
        measure=measure,
        validation_levels=E,
        probe_levels=probe_levels,
    )


def meta_env(
    reward: Reward = performance_gain,
    *,
    probe_levels: int = C,
    measure: Measure = episode_return,
    **options,
) -> SolverTrainingEnv:
    parts = {"proposals": ProblemChoices(SPACE.size, generate), "episode_length": L}
    return SolverTrainingEnv(
        solvers(K), view=view(probe_levels, measure), reward=reward, **{**parts, **options}
    )


def mixture() -> Mixture:
    return Mixture(torch.eye(SPACE.size), generate)


def play(env: SolverTrainingEnv, actions: torch.Tensor) -> TensorDict:
    """Step through actions [T, K, ...]; the transitions [K, T]."""
    state, steps = env.reset(), []
    for action in actions:
        step, state = env.step_and_maybe_reset(state.set("action", action))
        steps.append(step)
    return torch.stack(steps, 1)


def some_actions() -> torch.Tensor:
    return torch.randint(SPACE.size, (L, K, P), generator=torch.Generator().manual_seed(1))


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"probe_levels": 0},
        {"proposals": mixture()},
        {"episode_length": 6, "updates_per_step": 3},
        {"common_random_numbers": True},
    ],
)
def test_specs(options: dict) -> None:
    check_env_specs(meta_env(**options), break_when_any_done="both")


def test_an_episode_is_a_plain_loop_over_one_solver() -> None:
    env, start, streams, actions = meta_env(), solvers(1).snapshot(), Streams(9), some_actions()
    env.fork(start[0], streams)
    steps = play(env, actions)
    validation = target(E, streams.generator("validation"))
    for k in range(K):
        solver = solvers(1)
        solver.restore(start)
        returns = [evaluate(solver.agent, validation, None)["return"].mean()]
        for step in range(L):
            levels = SPACE.generate(actions[step, k], streams.generator(0, step, k, "levels"))
            solver.env.set_levels(levels[None])
            solver.update([streams.generator(0, step, k, "actions")])
            returns.append(evaluate(solver.agent, validation, None)["return"].mean())
        gains = torch.stack(returns).diff()
        torch.testing.assert_close(steps["next", "reward"][k, :, 0], gains, rtol=1e-3, atol=1e-5)
        assert gains.abs().max() > 1e-3
        own = probe(solver.agent, env.view.probes)[0]
        torch.testing.assert_close(steps["next", "probes"][k, -1], own, rtol=1e-3, atol=1e-4)


def test_rewards_sum_to_the_total_gain_on_the_one_validation_batch() -> None:
    env = meta_env()
    env.fork(solvers(1).snapshot()[0], Streams(2))
    validation = env.view.validation.clone()
    steps = play(env, some_actions())
    assert (env.view.validation == validation).all()
    final = evaluate(env.solvers.agent, validation, None)["return"].mean(1)
    initial = evaluate(solvers(1).agent, validation, None)["return"].mean(1)
    torch.testing.assert_close(steps["next", "reward"].sum((1, 2)), final - initial)


def test_the_gain_is_counted_in_what_is_measured() -> None:
    env = meta_env(measure=log_success)
    env.fork(solvers(1).snapshot()[0], Streams(9))
    steps = play(env, some_actions())
    validation = target(E, Streams(9).generator("validation"))
    success = evaluate(env.solvers.agent, validation, None)["success"]
    after = (success + 0.001).log().mean(1)
    torch.testing.assert_close(steps["next", "validation_return"][:, -1, 0], after)
    before = steps["validation_return"][:, 0, 0]
    torch.testing.assert_close(steps["next", "reward"].sum((1, 2)), after - before)


def test_all_copies_start_as_the_forked_solver() -> None:
    env = meta_env()
    solver = solvers(1)
    solver.update([torch.Generator().manual_seed(5)])
    env.fork(solver.snapshot()[0], Streams(2))
    state = env.reset()
    assert (state["probes"] == state["probes"][:1]).all()
    assert (state["validation_return"] == state["validation_return"][0]).all()
    assert (env.solvers.snapshot() == solver.snapshot()[[0] * K]).all()


def test_the_same_fork_and_actions_reproduce_rewards_bit_for_bit() -> None:
    env, start = meta_env(), solvers(1).snapshot()[0]
    runs = []
    for streams in (Streams(4), Streams(4), Streams(5)):
        env.fork(start, streams)
        runs.append(play(env, some_actions())["next", "reward"])
    assert torch.equal(runs[0], runs[1])
    assert not torch.equal(runs[0], runs[2])


def test_episodes_of_one_fork_start_alike_but_draw_anew() -> None:
    env = meta_env()
    env.fork(solvers(1).snapshot()[0], Streams(4))
    first, second = play(env, some_actions()), play(env, some_actions())
    assert torch.equal(first["probes"][:, 0], second["probes"][:, 0])
    assert not torch.equal(first["next", "reward"], second["next", "reward"])


def test_trained_solvers_stay_readable_after_the_automatic_reset() -> None:
    env = meta_env()
    env.fork(solvers(1).snapshot()[0], Streams(4))
    steps = play(env, some_actions())
    assert steps["next", "done"][:, -1].all() and not steps["next", "done"][:, :-1].any()
    after = evaluate(env.solvers.agent, env.view.validation, None)["return"].mean(1)
    torch.testing.assert_close(after, steps["next", "validation_return"][:, -1, 0])


def test_any_reward_can_be_paid() -> None:
    env = meta_env(task_difficulty)
    env.fork(solvers(1).snapshot()[0], Streams(4))
    reward = play(env, some_actions())["next", "reward"]
    assert ((reward >= 0) & (reward <= 1)).all() and reward.std() > 0


def test_a_reward_is_shown_the_whole_step() -> None:
    seen = []

    def reward(step: TrainingStep) -> torch.Tensor:
        success = evaluate(step.solver, target(E, Streams(1).generator()), None)["success"].mean(1)
        seen.append((step.levels.walls, step.rollout["planes"][:, :, 0, 0].bool()))
        return success

    env = meta_env(reward)
    env.fork(solvers(1).snapshot()[0], Streams(4))
    paid = play(env, some_actions())["next", "reward"][:, -1, 0]
    assert all(torch.equal(levels, played) for levels, played in seen)
    levels = target(E, Streams(1).generator())
    torch.testing.assert_close(paid, evaluate(env.solvers.agent, levels, None)["success"].mean(1))


def test_numbers_that_go_wrong_are_located() -> None:
    env = meta_env()
    broken = env.solvers.snapshot()[0].clone()
    next(iter(broken.values()))["value"].fill_(torch.nan)
    env.fork(broken, Streams(4))
    with pytest.raises(DivergedError, match="update 0 of the episode of the Solver's copies"):
        play(env, some_actions())


def test_every_step_is_reported() -> None:
    calls = []
    env = meta_env(on_step=lambda: calls.append(1))
    play(env, some_actions())
    assert len(calls) == L


def test_an_action_that_holds_is_the_same_action_repeated() -> None:
    actions = some_actions()[:2]
    held = meta_env(episode_length=4, updates_per_step=2)
    each = meta_env(episode_length=4)
    played = []
    for env, script in ((held, actions), (each, actions.repeat_interleave(2, 0))):
        env.fork(solvers(1).snapshot()[0], Streams(3))
        played.append(play(env, script))
    few, many = played
    assert few.batch_size == (K, 2)
    for entry in ("probes", "validation_return", "done", "progress"):
        assert torch.equal(few["next", entry], many["next", entry][:, 1::2])
    for entry in ("reward", "proposed"):
        pairs = many["next", entry].unflatten(1, (2, 2)).sum(2)
        torch.testing.assert_close(few["next", entry], pairs)


def test_a_held_actions_reward_adds_up_over_its_updates() -> None:
    env = meta_env(task_difficulty, episode_length=4, updates_per_step=4)
    env.fork(solvers(1).snapshot()[0], Streams(3))
    action = torch.zeros(1, K, P, dtype=torch.int64)
    reward = play(env, action)["next", "reward"].flatten()
    assert ((reward > 0) & (reward <= 4)).all() and (reward > 1).any()


def test_what_was_proposed_is_counted() -> None:
    env, actions = meta_env(), some_actions()
    env.fork(solvers(1).snapshot()[0], Streams(3))
    counted = play(env, actions)["next", "proposed"]
    for k in range(K):
        for step in range(L):
            expected = actions[step, k].bincount(minlength=SPACE.size)
            assert torch.equal(counted[k, step], expected)


def test_progress_runs_from_zero_to_one() -> None:
    env = meta_env()
    steps = play(env, some_actions())
    expected = torch.arange(L + 1) / L
    torch.testing.assert_close(steps["progress"][0, :, 0], expected[:-1])
    torch.testing.assert_close(steps["next", "progress"][0, :, 0], expected[1:])


def test_with_common_random_numbers_equal_actions_have_equal_consequences() -> None:
    action = torch.randn(1, 1, SPACE.size).expand(L, K, -1)
    spread = []
    for common in (True, False):
        env = meta_env(proposals=mixture(), common_random_numbers=common)
        env.fork(solvers(1).snapshot()[0], Streams(3))
        returns = play(env, action)["next", "validation_return"]
        spread.append(returns.std(0).max())
    assert spread[0] == 0 < spread[1]


def test_the_seed_decides_what_an_episode_draws() -> None:
    env, actions, trained = meta_env(), some_actions(), []
    for seed in (1, 2, 1):
        env.set_seed(seed)
        env.fork(solvers(1).snapshot()[0], env.streams)
        play(env, actions)
        levels, _ = env.last_training
        trained.append(levels.walls)
    assert torch.equal(trained[0], trained[2]) and not torch.equal(trained[0], trained[1])


def interrupted(actions: torch.Tensor, after: int) -> tuple[dict, TensorDict]:
    """An episode as it was before an update, and all of it."""
    env, seen = meta_env(), {}

    def pause() -> None:
        episode = env.episode()
        seen[len(episode["updates"])] = copy.deepcopy(episode)

    env.fork(solvers(1).snapshot()[0], Streams(9), pause)
    assert env.episode() is None
    steps = play(env, actions)
    assert sorted(seen) == list(range(1, L))
    return seen[after], steps


@pytest.mark.parametrize("after", [1, 3])
def test_an_interrupted_episode_goes_on_where_it_was(after: int) -> None:
    episode, whole = interrupted(some_actions(), after)
    env, trained = meta_env(), []
    update = env.solvers.update
    env.solvers.update = lambda *arguments: trained.append(1) or update(*arguments)
    env.fork(solvers(1).snapshot()[0], Streams(9))
    env.resume(episode)
    assert (play(env, some_actions()) == whole).all()
    assert len(trained) == L - after
    assert env.episode() is None


def test_an_interrupted_episode_takes_no_other_action() -> None:
    episode, _ = interrupted(some_actions(), 2)
    env, actions = meta_env(), some_actions()
    env.fork(solvers(1).snapshot()[0], Streams(9))
    env.resume(episode)
    actions[1, 0, 0] = (actions[1, 0, 0] + 1) % SPACE.size
    with pytest.raises(ReplayError, match="another action for update 1 of the episode"):
        play(env, actions)


def test_refuses_lengths_and_solvers_that_make_no_sense() -> None:
    for length, held in ((0, 1), (5, 2), (4, 0)):
        with pytest.raises(ValueError, match=rf"multiple of updates_per_step; got {length} and"):
            meta_env(episode_length=length, updates_per_step=held)
    with pytest.raises(ValueError, match="at least 0; got 6, -1"):
        meta_env(probe_levels=-1)
    ppo = solvers(1)
    ppo.agent.copies = None
    with pytest.raises(ValueError, match="must be a population"):
        SolverTrainingEnv(ppo, view=view(), proposals=mixture(), reward=performance_gain)
