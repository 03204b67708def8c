from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import nn

from proposer_rl.curricula import (
    Curriculum,
    FrozenProposer,
    Improvement,
    ProposerCurriculum,
    SamplingCurriculum,
    ScheduleCurriculum,
    load_agent,
)
from proposer_rl.curricula.proposer import explained_share
from proposer_rl.learning.advantages import LeaveOneOutBaseline
from proposer_rl.learning.ppo import PPO, PPOSettings
from proposer_rl.models import (
    MapEncoder,
    MixtureHead,
    ProblemHead,
    ProposerNetwork,
    categorical,
    normal,
    proposer_actor_critic,
)
from proposer_rl.streams import Streams
from tests.meta.test_env import SPACE, K, L, P, meta_env, mixture, solvers


def sample(count: int, generator: torch.Generator):
    return SPACE.sample((count,), generator)


def network(head: nn.Module) -> ProposerNetwork:
    return ProposerNetwork(head, MapEncoder(7, (8, 8), 8), context=8, hidden=8)


def proposer(
    advance: str = "train", *, own_action: str = "sample", mix: bool = False, **options
) -> ProposerCurriculum:
    """A Proposer of problem choices, or of mixtures that hold for the options' updates."""
    env = meta_env(**({"proposals": mixture()} if mix else {}), **options)
    torch.manual_seed(0)
    head = MixtureHead(8, SPACE.size, hidden=8) if mix else ProblemHead(8, P, SPACE.size, hidden=8)
    settings = PPOSettings(horizon=env.steps, gamma=1.0, epochs=2)
    agent = proposer_actor_critic(network(head), normal if mix else categorical)
    ppo = PPO(env, agent, settings, advantage=LeaveOneOutBaseline(1.0) if mix else None)
    return ProposerCurriculum(ppo, advance=advance, own_action=own_action)


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
    assert sum(metrics["histogram"]) == K * L * P
    assert not (curriculum.proposer.snapshot() == before).all()


def test_the_explained_share_is_that_of_a_linear_model() -> None:
    actions = torch.randn(8, 3, 2, generator=torch.Generator().manual_seed(0))
    mean = actions.mean(1)
    gains = 0.1 + mean @ torch.tensor([0.5, -1.0])
    assert explained_share(actions, gains) == pytest.approx(1)
    generator = torch.Generator().manual_seed(1)
    noise = [explained_share(actions, torch.randn(8, generator=generator)) for _ in range(2000)]
    assert abs(sum(noise) / 2000) < 0.03  # on average nothing, where there is nothing
    noisy = gains + torch.randn(8, generator=generator)
    _, squares, *_ = np.linalg.lstsq(np.c_[np.ones(8), mean.numpy()], noisy.numpy())
    share = 1 - (squares[0] / 5) / noisy.numpy().var(ddof=1)
    assert explained_share(actions, noisy) == pytest.approx(share, abs=1e-5)


def test_the_explained_share_is_unknown_where_it_cannot_be_told() -> None:
    gains = torch.randn(4)
    assert explained_share(torch.zeros(4, 2, 6, dtype=torch.int64), gains) is None
    assert explained_share(torch.randn(4, 1, 3), gains) is None
    assert explained_share(torch.randn(4, 1, 2), torch.zeros(4)) is None


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


@pytest.mark.parametrize("mix", [False, True])
def test_a_restored_proposer_proposes_and_improves_alike(mix: bool) -> None:
    options = {"mix": True, "episode_length": 4, "updates_per_step": 4} if mix else {}
    original, solver = proposer(**options), solvers(1)
    original.improve(solver, [Streams(0, "cycle", 0)])
    original.propose(solver, [Streams(0, "update", 0)])
    original.observe(None, None)
    resumed = proposer(**options)
    resumed.load_state_dict(original.state_dict())
    for curriculum in (original, resumed):
        # In the middle of a step of 4 updates the action is that of its first.
        curriculum.levels = curriculum.propose(solver, [Streams(0, "update", 1)])
        curriculum.outcome = curriculum.improve(solver, [Streams(0, "cycle", 1)])
    assert (original.levels == resumed.levels).all()
    assert original.outcome == resumed.outcome


class Stop(Exception):
    """An interruption."""


def interrupt(curriculum: ProposerCurriculum, solver: PPO, pauses: int) -> dict:
    """The state at a pause within improving, as a checkpoint has it."""
    states = []

    def pause() -> None:
        states.append(curriculum.state_dict())
        if len(states) == pauses:
            raise Stop

    with pytest.raises(Stop):
        curriculum.improve(solver, [Streams(0, "cycle", 0)], pause)
    return states[-1]


KINDS = [{}, {"mix": True, "episode_length": 6, "updates_per_step": 3}]


@pytest.mark.parametrize("pauses", [1, 4])  # within the first step, and with held actions after it
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("advance", ["train", "best"])
def test_an_interrupted_episode_goes_on_as_if_it_had_never_stopped(
    advance: str, kind: dict, pauses: int
) -> None:
    whole, solver = proposer(advance, **kind), solvers(1)
    expected = whole.improve(solver, [Streams(0, "cycle", 0)])
    steps = []
    resumed, again = proposer(advance, on_step=lambda: steps.append(1), **kind), solvers(1)
    resumed.load_state_dict(interrupt(proposer(advance, **kind), solvers(1), pauses))
    trained = []
    update = resumed.env.solvers.update
    resumed.env.solvers.update = lambda *a: trained.append(1) or update(*a)
    outcome = resumed.improve(again, [Streams(0, "cycle", 0)])
    assert outcome.metrics == expected.metrics
    assert (resumed.proposer.snapshot() == whole.proposer.snapshot()).all()
    assert (again.snapshot() == solver.snapshot()).all()
    # What had been trained before is not trained again, but is counted.
    length = resumed.env.episode_length
    assert len(steps) == length and len(trained) == length - pauses
    assert resumed.env.episode() is None
    # The next cycle begins anew.
    expected = whole.improve(solver, [Streams(0, "cycle", 1)])
    assert resumed.improve(again, [Streams(0, "cycle", 1)]).metrics == expected.metrics


def test_an_episode_that_cannot_be_repeated_is_begun_anew() -> None:
    """As on another machine, where rounding can change an action."""
    expected = proposer().improve(solvers(1), [Streams(0, "cycle", 0)])
    state = interrupt(proposer(), solvers(1), 2)
    state["episode"]["updates"][1]["action"][0, 0] += 1
    resumed = proposer()
    resumed.load_state_dict(state)
    assert resumed.improve(solvers(1), [Streams(0, "cycle", 0)]).metrics == expected.metrics


def test_an_own_action_holds_and_a_mode_is_no_matter_of_chance() -> None:
    options = {"mix": True, "episode_length": 4, "updates_per_step": 2}
    actions = {}
    for own in ("sample", "mode"):
        curriculum, solver = proposer(own_action=own, **options), solvers(1)
        curriculum.improve(solver, [Streams(0, "cycle", 0)])
        actions[own] = []
        for update in range(4):
            curriculum.propose(solver, [Streams(0, "update", update)])
            curriculum.observe(None, None)
            actions[own].append(curriculum.state_dict()["action"])
    first, same, other, _ = actions["sample"]
    assert torch.equal(first, same) and not torch.equal(first, other)
    expected = curriculum.agent(curriculum.view.observe(solver.agent, 0.5))["logits"][..., 0]
    torch.testing.assert_close(actions["mode"][2], expected)


@pytest.mark.parametrize("own", ["sample", "mode"])
def test_a_frozen_one_proposes_the_same_and_learns_no_more(own: str) -> None:
    learnt, solver = proposer(own_action=own), solvers(1)
    learnt.improve(solver, [Streams(0, "cycle", 0)])
    frozen, before = learnt.frozen(), learnt.proposer.snapshot()
    assert frozen.improve(solver, [Streams(0, "cycle", 0)]) == Improvement()
    for update in range(3):
        stream = Streams(0, "update", update)
        expected = learnt.propose(solver, [stream])
        assert (frozen.propose(solver, [stream]) == expected).all()
    assert (learnt.proposer.snapshot() == before).all()


def test_a_frozen_proposer_proposes_what_it_learnt_and_costs_nothing() -> None:
    learnt, solver = proposer(), solvers(1)
    learnt.improve(solver, [Streams(0, "cycle", 0)])
    head = ProblemHead(8, P, SPACE.size, hidden=8)
    agent = proposer_actor_critic(network(head), categorical)
    load_agent(agent, learnt.proposer.snapshot())
    env = meta_env()
    frozen = FrozenProposer(agent, env.view, env.proposals, episode_length=L)
    assert frozen.improve(solver, [Streams(0, "cycle", 0)]) == Improvement()
    for update in range(3):
        levels = [
            curriculum.propose(solver, [Streams(0, "update", update)])
            for curriculum in (learnt, frozen)
        ]
        assert (levels[0] == levels[1]).all()


def test_a_frozen_proposer_refuses_weights_of_another_network() -> None:
    agent = proposer_actor_critic(network(MixtureHead(8, 3, hidden=8)), normal)
    with pytest.raises(ValueError, match="belongs to another network"):
        load_agent(agent, proposer().proposer.snapshot())


def test_refuses_what_does_not_fit() -> None:
    with pytest.raises(ValueError, match=r"advance must be one of .* got 'all'"):
        proposer("all")
    with pytest.raises(ValueError, match=r"own_action must be one of .* got 'mean'"):
        proposer(own_action="mean")
    with pytest.raises(ValueError, match="must be a SolverTrainingEnv"):
        ProposerCurriculum(solvers(1))
    with pytest.raises(ValueError, match="horizon 4 must be the meta-environment's number of"):
        settings = PPOSettings(horizon=4)
        agent = proposer_actor_critic(network(ProblemHead(8, P, SPACE.size)), categorical)
        ProposerCurriculum(PPO(meta_env(), agent, settings))
