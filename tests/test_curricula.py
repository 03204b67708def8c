from __future__ import annotations

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch import nn

from proposer_rl.curricula import (
    Choice,
    Curriculum,
    Improvement,
    Proposal,
    ProposerCurriculum,
    ProposerTrainer,
    SamplingCurriculum,
    ScheduleCurriculum,
    Scorer,
)
from proposer_rl.curricula.proposer import explained_share
from proposer_rl.learning import PPO, LeaveOneOutBaseline, agent_weights, load_agent
from proposer_rl.meta.rewards import log_success_gain
from proposer_rl.models import (
    ActorCritic,
    MixtureHead,
    ProblemHead,
    ProposerNetwork,
    categorical,
    normal,
    proposer_actor_critic,
)
from proposer_rl.settings import PPOSettings
from proposer_rl.streams import Streams
from proposer_rl.task import Levels
from tests.meta.test_env import SPACE, E, K, L, P, meta_env, mixture
from tests.tiny import TASK, learners

HELD = {"mix": True, "meta_episode_length": 4, "action_repeat": 2}


def cycle(number: int) -> list[Streams]:
    return [Streams(0, "cycle", number)]


def update(number: int) -> list[Streams]:
    return [Streams(0, "update", number)]


def proposer_agent(mix: bool) -> ActorCritic:
    torch.manual_seed(0)
    head: nn.Module = ProblemHead(8, P, SPACE.size, hidden=8)
    if mix:
        head = MixtureHead(8, SPACE.size, hidden=8)
    network = ProposerNetwork(head, TASK.probe_encoder(8), context=8, hidden=8)
    return proposer_actor_critic(network, normal if mix else categorical)


def proposer(
    advance: str = "train", *, own_action: str = "sample", mix: bool = False, **options
) -> ProposerCurriculum:
    """A Proposer of problem choices, or of mixtures."""
    env = meta_env(**({"actions": mixture()} if mix else {}), **options)
    settings = PPOSettings(horizon=env.steps, gamma=1.0, epochs=2)
    advantage = LeaveOneOutBaseline(1.0) if mix else None
    ppo = PPO(env, proposer_agent(mix), settings, advantage=advantage)
    return ProposerTrainer(ppo, advance=advance).curriculum(own_action)


def frozen(learnt: ProposerCurriculum, choice: Choice | None = None) -> ProposerCurriculum:
    """The same Proposer, learning no more."""
    return ProposerCurriculum(
        learnt.agent,
        learnt.view,
        learnt.actions,
        meta_episode_length=learnt.meta_episode_length,
        action_repeat=learnt.action_repeat,
        own_action=learnt.own_action,
        choice=choice,
    )


def weights(curriculum: ProposerCurriculum) -> TensorDict:
    assert curriculum.trainer is not None
    return curriculum.trainer.learner.snapshot()


def test_a_copys_levels_depend_on_its_stream_alone() -> None:
    curriculum = SamplingCurriculum(SPACE)
    both = curriculum.propose(learners(2), 0, [Streams(0), Streams(1)])
    alone = curriculum.propose(learners(1), 0, [Streams(1)])
    assert both.levels.batch_size == (2, P) and both[1:] == (0, 0)
    assert (both.levels[1] == alone.levels[0]).all()
    assert not (both.levels[0] == both.levels[1]).all()


class Stage(Curriculum):
    """Notes what it is called for."""

    def __init__(self, name: str, calls: list) -> None:
        self.name, self.calls, self.state = name, calls, 0

    def begin(self) -> None:
        self.calls.append((self.name, "begin"))

    def propose(self, learner, updates, streams) -> Proposal:
        self.calls.append((self.name, "propose", updates))
        return Proposal(self.name, frames=3, evaluations=4)

    def observe(self, learner, levels, update) -> None:
        self.calls.append((self.name, "observe", levels))
        self.state += 1

    def improve(self, learner, updates, streams) -> Improvement:
        self.calls.append((self.name, "improve", updates))
        return Improvement({"of": self.name}, frames=5, evaluations=6)

    def state_dict(self) -> dict:
        return {"state": self.state}

    def load_state_dict(self, state) -> None:
        self.state = state["state"]

    def close(self) -> None:
        self.calls.append((self.name, "close"))


def schedule(calls: list) -> ScheduleCurriculum:
    return ScheduleCurriculum([Stage(name, calls) for name in "abc"], until=[2, 3])


def test_a_schedule_passes_everything_on_and_changes_at_the_exact_update() -> None:
    calls: list = []
    curriculum = schedule(calls)
    curriculum.begin()
    assert calls == [(name, "begin") for name in "abc"]
    calls.clear()
    for updates in range(5):
        if updates == 3:  # interrupted, and put back from its state
            state = curriculum.state_dict()
            curriculum = schedule(calls)
            curriculum.load_state_dict(state)
        if updates % 2 == 0:
            improved = curriculum.improve(None, updates, [])
            assert improved == Improvement({"of": calls[-1][0]}, frames=5, evaluations=6)
        proposal = curriculum.propose(None, updates, [])
        assert proposal == (calls[-1][0], 3, 4)
        curriculum.observe(None, proposal.levels, None)
    expected = []
    for updates, name in enumerate("aabcc"):
        expected += [(name, "improve", updates)] * (updates % 2 == 0)
        expected += [(name, "propose", updates), (name, "observe", name)]
    assert calls == expected
    assert [stage["state"] for stage in curriculum.state_dict()["stages"]] == [2, 1, 2]
    calls.clear()
    curriculum.close()
    assert calls == [(name, "close") for name in "abc"]


def test_a_schedule_trains_copies_where_a_stage_does() -> None:
    stages = [Stage("a", []), Stage("b", [])]
    assert not ScheduleCurriculum(stages, [1]).trains_copies
    stages[1].trains_copies = True
    assert ScheduleCurriculum(stages, [1]).trains_copies


def test_a_schedule_hands_on_what_its_last_stage_has_learnt() -> None:
    stages = [Stage(name, []) for name in "abc"]
    assert ScheduleCurriculum(stages, [1, 2]).learnt() == {}
    stages[0].learnt, stages[1].learnt = (lambda: {"proposer": 0}), (lambda: {"proposer": 1})
    assert ScheduleCurriculum(stages, [1, 2]).learnt() == {"proposer": 1}


def test_a_proposer_may_begin_within_a_cycle() -> None:
    stages = [SamplingCurriculum(SPACE), proposer(mix=True, action_repeat=L)]
    curriculum = ScheduleCurriculum(stages, [1])
    curriculum.improve(learners(1), 0, cycle(0))
    for updates in range(3):
        proposal = curriculum.propose(learners(1), updates, cycle(updates))
        assert proposal.levels.batch_size == (1, P)
    assert stages[1].state_dict()["began"] == 1


def test_a_schedule_starts_anew_with_the_next_solver() -> None:
    calls: list = []
    curriculum = schedule(calls)
    proposed = []
    for _ in range(2):
        curriculum.begin()
        proposed.append([curriculum.propose(None, updates, []).levels for updates in range(4)])
    assert proposed == [list("aabc")] * 2


@pytest.mark.parametrize("until", [[], [2], [3, 2], [2, 2], [0, 4]])
def test_a_schedule_refuses_ends_that_do_not_fit(until: list[int]) -> None:
    with pytest.raises(ValueError, match="3 stages need 2 ascending positive"):
        ScheduleCurriculum([SamplingCurriculum(SPACE)] * 3, until)


def test_a_curriculum_must_propose() -> None:
    with pytest.raises(TypeError, match="Curriculum must define propose"):
        Curriculum().propose(learners(1), 0, [Streams(0)])


def test_improving_reports_gains_cost_and_proposals() -> None:
    curriculum = proposer(reward=log_success_gain)
    before = weights(curriculum)
    outcome = curriculum.improve(learners(1), 0, cycle(0))
    assert outcome.frames == K * P * 8 * L
    assert outcome.evaluations == K * (L + 1) * E
    assert outcome.advance is None
    metrics = outcome.metrics
    assert len(metrics["return_gain"]) == len(metrics["log_success_gain"]) == K
    # What is paid is this gain, so over an episode both add up to the same; not to the other.
    assert metrics["total_reward"] == pytest.approx(metrics["log_success_gain"], abs=1e-5)
    assert metrics["total_reward"] != pytest.approx(metrics["return_gain"], abs=1e-3)
    assert metrics["reward_sd"] == pytest.approx(np.std(metrics["total_reward"]), abs=1e-6)
    assert np.shape(metrics["histogram"]) == (2, 2)  # fractions, lengths
    assert np.sum(metrics["histogram"]) == K * L * P
    assert not (weights(curriculum) == before).all()


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
    curriculum, solver = proposer(advance), learners(1)
    before = solver.snapshot()
    outcome = curriculum.improve(solver, 0, cycle(0))
    assert curriculum.trainer is not None
    copies = curriculum.trainer.env.solvers.snapshot()
    equal = [bool((solver.snapshot()[0] == copies[k]).all()) for k in range(K)]
    if advance == "train":
        assert (solver.snapshot() == before).all() and outcome.advance is None
    else:
        assert sum(equal) == 1 and outcome.advance is not None
        assert outcome.advance.updates == L
        assert outcome.advance.levels.batch_size == (1, P)
        assert outcome.advance.update.rollout.batch_size == (1, P, 8)
    if advance == "best":
        rewards = outcome.metrics["total_reward"]
        assert equal.index(True) == rewards.index(max(rewards))


def test_proposals_are_a_function_of_solver_proposer_and_stream() -> None:
    curriculum, solver = proposer(), learners(1)
    curriculum.improve(solver, 0, cycle(0))
    one, same, other = (curriculum.propose(solver, 3, update(number)) for number in (3, 3, 4))
    assert one.levels.batch_size == (1, P)
    assert (one.levels == same.levels).all() and not (one.levels == other.levels).all()


def test_proposing_costs_an_evaluation_where_an_action_begins() -> None:
    curriculum, solver = proposer(**HELD), learners(1)
    curriculum.improve(solver, 6, cycle(0))
    costs = [curriculum.propose(solver, updates, update(0))[1:] for updates in range(6, 10)]
    assert costs == [(0, E), (0, 0), (0, E), (0, 0)]


@pytest.mark.parametrize("options", [{}, HELD], ids=["problems", "mixtures"])
def test_a_restored_proposer_proposes_and_improves_alike(options: dict) -> None:
    original, solver = proposer(**options), learners(1)
    original.improve(solver, 0, cycle(0))
    original.propose(solver, 0, update(0))
    resumed = proposer(**options)
    resumed.load_state_dict(original.state_dict())
    came = []
    for curriculum in (original, resumed):
        # Where an action holds for two updates, that of the second is the first's.
        levels = [curriculum.propose(solver, number, update(number)).levels for number in (1, 2)]
        came.append((levels, curriculum.improve(solver, 3, cycle(1)).metrics, weights(curriculum)))
    (levels, metrics, learnt), (other_levels, other_metrics, other_learnt) = came
    assert all((one == other).all() for one, other in zip(levels, other_levels, strict=True))
    assert metrics == other_metrics and (learnt == other_learnt).all()


@pytest.mark.parametrize("advance", ["train", "best"])
def test_an_interrupted_episode_is_played_again(advance: str) -> None:
    class Stop(Exception):
        """An interruption."""

    def stop(done: int) -> None:
        raise Stop

    whole, solver = proposer(advance, **HELD), learners(1)
    expected = whole.improve(solver, 0, cycle(0))
    broken_off, again = proposer(advance, **HELD), learners(1)
    before = broken_off.state_dict()
    assert broken_off.trainer is not None
    broken_off.trainer.env.on_update = stop
    with pytest.raises(Stop):
        broken_off.improve(again, 0, cycle(0))
    # In the same process, and in another one.
    broken_off.trainer.env.on_update = lambda done: None
    for resumed in (broken_off, proposer(advance, **HELD)):
        fresh = learners(1)
        resumed.load_state_dict(before)
        assert resumed.improve(fresh, 0, cycle(0)).metrics == expected.metrics
        assert (weights(resumed) == weights(whole)).all()
        assert (fresh.snapshot() == solver.snapshot()).all()


def test_an_own_action_holds_and_a_mode_is_no_matter_of_chance() -> None:
    actions = {}
    for own in ("sample", "mode"):
        curriculum, solver = proposer(own_action=own, **HELD), learners(1)
        curriculum.improve(solver, 0, cycle(0))
        actions[own] = []
        for number in range(4):
            curriculum.propose(solver, number, update(number))
            actions[own].append(curriculum.state_dict()["action"])
    first, same, other, _ = actions["sample"]
    assert torch.equal(first, same) and not torch.equal(first, other)
    expected = curriculum.agent(curriculum.view.observe(solver.agent, 0.5))["logits"][..., 0]
    torch.testing.assert_close(actions["mode"][2], expected)


@pytest.mark.parametrize("own", ["sample", "mode"])
def test_a_frozen_one_proposes_what_was_learnt_and_learns_no_more(own: str) -> None:
    learnt, solver = proposer(own_action=own), learners(1)
    learnt.improve(solver, 0, cycle(0))
    # Another network with its weights, as from a checkpoint.
    agent = proposer_agent(mix=False)
    load_agent(agent, weights(learnt))
    env = meta_env()
    loaded = ProposerCurriculum(
        agent, env.view, env.actions, meta_episode_length=L, action_repeat=1, own_action=own
    )
    before = weights(learnt)
    assert loaded.improve(solver, 0, cycle(0)) == Improvement()
    for number in range(3):
        expected = learnt.propose(solver, number, update(number)).levels
        assert (loaded.propose(solver, number, update(number)).levels == expected).all()
    assert (weights(learnt) == before).all()


@pytest.mark.parametrize("mix", [False, True])
def test_a_frozen_ones_solver_trains_on_the_most_learnable_of_more_proposals(mix: bool) -> None:
    learnt, solver = proposer(mix=mix), learners(1)
    choice = Choice(Scorer(TASK, "learnability", "exact"), times=4, temperature=1e-5)
    curriculum = frozen(learnt, choice)
    proposal = curriculum.propose(solver, 0, update(0))
    action = curriculum.state_dict()["action"]
    many, bins = learnt.actions.levels(action, 4 * P, update(0))
    if not mix:  # each level that the action names, four times
        assert torch.equal(bins.sort().values, action.repeat_interleave(4, 1).sort().values)
    assert proposal.evaluations == curriculum.view.validation_levels + 4 * P

    def learnability(levels: Levels) -> torch.Tensor:
        success = TASK.performance(solver.agent, levels, torch.Generator())["success"]
        return (success * (1 - success)).sort(descending=True).values

    torch.testing.assert_close(learnability(proposal.levels), learnability(many)[:, :P])


def test_a_fresh_solvers_cycle_is_not_the_last_ones() -> None:
    curriculum, solver = proposer(**HELD), learners(1)
    curriculum.improve(solver, 4, cycle(0))
    curriculum.propose(solver, 4, update(4))
    curriculum.begin()
    state = curriculum.state_dict()
    assert state["began"] == 0 and state["action"] is None


def test_a_frozen_one_sees_the_next_solver_through_levels_of_its_life() -> None:
    """As one that has seen no other Solver."""
    lives = [[Streams(0, *scope)] for scope in ((), ("lifetime", 1))]
    first, second = learners(1), TASK.learner([Streams(1, "solver")])
    old, fresh = (frozen(proposer(**HELD)) for _ in range(2))
    old.improve(first, 5, lives[0])
    for updates in (5, 6, 7):  # the last begins an action that is to hold for one more
        old.propose(first, updates, update(updates))
    old.begin()
    seen = []
    for curriculum in (old, fresh):
        curriculum.improve(second, 0, lives[1])
        levels = [curriculum.propose(second, n, update(n)).levels for n in range(3)]
        for purpose in ("validation", "probes"):
            looked_at = getattr(curriculum.view, purpose)
            generator = lives[1][0].generator(purpose)
            assert (looked_at == TASK.target.sample(len(looked_at), generator)).all()
        seen.append(levels)
    assert all((one == other).all() for one, other in zip(*seen, strict=True))


def test_a_frozen_one_goes_on_with_its_own_weights() -> None:
    """Whatever has become of the checkpoint that they came from."""
    curriculum = frozen(proposer())
    state, before = curriculum.state_dict(), agent_weights(curriculum.agent)
    resumed = frozen(proposer())
    for weight in resumed.agent.parameters():
        weight.data.zero_()
    resumed.load_state_dict(state)
    assert (agent_weights(resumed.agent) == before).all()


def test_a_cycle_beyond_the_episodes_that_it_learnt_in_begins_another(monkeypatch) -> None:
    curriculum, solver, seen = frozen(proposer(**HELD)), learners(1), []
    observe = curriculum.view.observe

    def noted(agent: ActorCritic, progress: float, *place: int) -> TensorDict:
        seen.append(progress)
        return observe(agent, progress, *place)

    monkeypatch.setattr(curriculum.view, "observe", noted)
    for number in range(10):
        curriculum.propose(solver, number, update(number))
    assert seen == [0, 0.5, 0, 0.5, 0]  # four updates of an episode, two of an action


def test_a_frozen_proposer_refuses_weights_of_another_network() -> None:
    with pytest.raises(ValueError, match="belongs to another network"):
        load_agent(proposer_agent(mix=True), weights(proposer()))


def test_refuses_what_does_not_fit() -> None:
    with pytest.raises(ValueError, match="must be a SolverTrainingEnv"):
        ProposerTrainer(learners(1))
    with pytest.raises(ValueError, match="horizon 4 must be the meta-environment's number of"):
        ProposerTrainer(PPO(meta_env(), proposer_agent(mix=False), PPOSettings(horizon=4)))
