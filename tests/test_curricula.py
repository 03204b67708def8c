from __future__ import annotations

import pytest
import torch

from proposer_rl.curricula import (
    Curriculum,
    ProposerCurriculum,
    SamplingCurriculum,
    ScheduleCurriculum,
)
from proposer_rl.models import ProposerNetwork, proposer_actor_critic
from proposer_rl.ppo import PPO, PPOSettings
from proposer_rl.streams import Streams
from tests.test_meta_env import SPACE, K, L, P, meta_env, solvers


def sample(count: int, generator: torch.Generator):
    return SPACE.sample((count,), generator)


def proposer(advance: str = "train", ratio: str = "per_problem", **ppo) -> ProposerCurriculum:
    env = meta_env()
    torch.manual_seed(0)
    network = ProposerNetwork(7, P, SPACE.size, context=8, hidden=8, channels=(8, 8))
    settings = PPOSettings(horizon=L, gamma=1.0, epochs=2, **ppo)
    ppo = PPO(env, proposer_actor_critic(network, ratio), settings)
    return ProposerCurriculum(ppo, advance=advance, histogram=SPACE.histogram)


def test_a_copys_levels_depend_on_its_stream_alone() -> None:
    curriculum = SamplingCurriculum(sample)
    both = curriculum.propose(solvers(2), [Streams(0), Streams(1)])
    alone = curriculum.propose(solvers(1), [Streams(1)])
    assert both.batch_size == (2, P)
    assert (both[1] == alone[0]).all()
    assert not (both[0] == both[1]).all()


def test_a_schedule_changes_after_the_given_updates_and_resumes() -> None:
    class Named(Curriculum):
        def __init__(self, name: str) -> None:
            self.name = name

        def propose(self, solver, streams):
            return self.name

    def schedule() -> ScheduleCurriculum:
        return ScheduleCurriculum([Named("a"), Named("b"), Named("c")], until=[2, 3])

    curriculum, seen = schedule(), []
    for update in range(6):
        if update == 3:  # interrupted, and put back from its state
            state = curriculum.state_dict()
            curriculum = schedule()
            curriculum.load_state_dict(state)
        seen.append(curriculum.propose(None, []))
        curriculum.observe(None, None)
    assert seen == ["a", "a", "b", "c", "c", "c"]


@pytest.mark.parametrize("until", [[], [2], [3, 2], [2, 2], [0, 4]])
def test_a_schedule_refuses_ends_that_do_not_fit(until: list[int]) -> None:
    with pytest.raises(ValueError, match="3 stages need 2 ascending positive"):
        ScheduleCurriculum([SamplingCurriculum(sample)] * 3, until)


def test_a_curriculum_must_propose() -> None:
    with pytest.raises(TypeError, match="Curriculum must define propose"):
        Curriculum().propose(solvers(1), [Streams(0)])


def test_improving_reports_gains_cost_and_proposals() -> None:
    curriculum, solver = proposer(), solvers(1)
    before = curriculum.proposer.snapshot()
    outcome = curriculum.improve(solver, [Streams(0, "cycle", 0)])
    assert outcome.meta_frames == K * P * 8 * L
    assert outcome.advance is None
    metrics = outcome.metrics
    assert len(metrics["total_gain"]) == K
    # The reward is the gain, so over an episode both add up to the same.
    torch.testing.assert_close(
        torch.tensor(metrics["total_gain"]), torch.tensor(metrics["total_reward"])
    )
    assert sum(map(sum, metrics["histogram"])) == K * L * P
    assert not (curriculum.proposer.snapshot() == before).all()


@pytest.mark.parametrize("advance", ["train", "best", "random"])
def test_what_becomes_of_the_solver(advance: str) -> None:
    curriculum, solver = proposer(advance), solvers(1)
    before = solver.snapshot()
    outcome = curriculum.improve(solver, [Streams(0, "cycle", 0)])
    copies = curriculum.env.solvers.snapshot()
    equal = [bool((solver.snapshot()[0] == copies[k]).all()) for k in range(K)]
    if advance == "train":
        assert (solver.snapshot() == before).all() and outcome.advance is None
    else:
        assert sum(equal) == 1 and outcome.advance.updates == L
        assert outcome.advance.levels.batch_size == (1, P)
        assert outcome.advance.update.rollout.batch_size == (1, P, 8)
    if advance == "best":
        gains = outcome.metrics["total_gain"]
        assert equal.index(True) == gains.index(max(gains))


def test_proposals_are_a_function_of_solver_proposer_and_stream() -> None:
    curriculum, solver = proposer(), solvers(1)
    curriculum.improve(solver, [Streams(0, "cycle", 0)])
    one, same, other = (
        curriculum.propose(solver, [Streams(0, "update", update)]) for update in (3, 3, 4)
    )
    assert one.batch_size == (1, P)
    assert (one == same).all() and not (one == other).all()


def test_a_restored_proposer_proposes_and_improves_alike() -> None:
    original, solver = proposer(), solvers(1)
    original.improve(solver, [Streams(0, "cycle", 0)])
    resumed = proposer()
    resumed.load_state_dict(original.state_dict())
    for curriculum in (original, resumed):
        curriculum.levels = curriculum.propose(solver, [Streams(0, "update", 3)])
        curriculum.outcome = curriculum.improve(solver, [Streams(0, "cycle", 1)])
    assert (original.levels == resumed.levels).all()
    assert original.outcome == resumed.outcome


def test_refuses_what_does_not_fit() -> None:
    with pytest.raises(ValueError, match=r"advance must be one of .* got 'all'"):
        proposer("all")
    with pytest.raises(ValueError, match="must be a SolverTrainingEnv"):
        ProposerCurriculum(solvers(1))
    with pytest.raises(ValueError, match="horizon 4 must be the meta-environment's episode"):
        settings = PPOSettings(horizon=4)
        agent = proposer_actor_critic(ProposerNetwork(7, P, SPACE.size))
        ProposerCurriculum(PPO(meta_env(), agent, settings))
