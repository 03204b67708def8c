"""PPO against plain formulas: advantages, losses, gradients, copies together and apart."""

from __future__ import annotations

import copy
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torch.distributions import Categorical
from torch.nn.functional import smooth_l1_loss
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves
from torchrl.envs import RenameTransform, TransformedEnv
from torchrl.objectives import A2CLoss, ReinforceLoss

from proposer_rl.learning import PPO, LeaveOneOutBaseline, MakeLoss, PPOSettings
from proposer_rl.learning.objective import clip_gradients_
from proposer_rl.learning.ppo import complete_adam
from proposer_rl.models import ActorCritic, Population, UNet, map_actor_critic
from proposer_rl.models.grids import read_maps
from proposer_rl.streams import Streams
from proposer_rl.tasks.mazes import Level, MazeEnv, generate_levels
from proposer_rl.tasks.view_mazes.view_env import ViewMazeEnv
from tests.draws import generators
from tests.host_reads import NoHostReads
from tests.tiny import TASK, tiny_view_task

P, T = 6, 12
SETTINGS = PPOSettings(horizon=T, epochs=3, max_grad_norm=0.5)


def levels(copies: int, seed: int = 0) -> Level:
    generator = torch.Generator().manual_seed(seed)
    return generate_levels(torch.full((copies, P), 0.2), 2, 5, 5, generator=generator)


def learner(
    copies: int = 1,
    settings: PPOSettings = SETTINGS,
    observe_agent: bool = False,
    *,
    per_step: bool | None = None,
    batched: bool | None = None,
    loss: MakeLoss | None = None,
) -> PPO:
    torch.manual_seed(3)

    def make() -> UNet:
        return UNet(in_channels=4 if observe_agent else 3, channels=(8, 16), groups=4)

    per_step = observe_agent if per_step is None else per_step
    agent = map_actor_critic(Population(make, copies, batched=batched), per_step=per_step)
    env = MazeEnv(levels(copies), max_steps=5, observe_agent=observe_agent)
    return PPO(env, agent, settings, loss=loss)


def hand_gae(rollout: TensorDict, gamma: float, lmbda: float) -> Tensor:
    """Advantages by the recursion from the last step to the first, one environment at a time."""
    value, following = rollout["state_value"], rollout["next", "state_value"]
    reward, terminated = rollout["next", "reward"], rollout["next", "terminated"]
    done = rollout["next", "done"]
    advantage = torch.zeros_like(value)
    for k in range(value.shape[0]):
        for p in range(value.shape[1]):
            after = 0.0
            for t in reversed(range(value.shape[2])):
                at = (k, p, t, 0)
                bootstrap = 0.0 if terminated[at] else float(following[at])
                delta = float(reward[at]) + gamma * bootstrap - float(value[at])
                after = delta + (0.0 if done[at] else gamma * lmbda * after)
                advantage[at] = after
    return advantage


def test_advantages_equal_a_hand_recursion_with_both_kinds_of_end() -> None:
    ppo = learner(copies=2)
    rollout = ppo.collect(generators(0, 1))
    ends = rollout["next"]
    assert ends["terminated"][:, :, :-1].any() and ends["truncated"][:, :, :-1].any()
    ppo.optimise(rollout)
    expected = hand_gae(rollout, SETTINGS.gamma, SETTINGS.lmbda)
    torch.testing.assert_close(rollout["advantage"], expected, rtol=1e-4, atol=1e-5)
    target = expected + rollout["state_value"]
    torch.testing.assert_close(rollout["value_target"], target, rtol=1e-4, atol=1e-5)


def plain_loss(ppo: PPO, batch: TensorDict, k: int, settings: PPOSettings) -> Tensor:
    """PPO's clipped loss of one copy, one forward pass per transition, from the formulas."""
    state = batch.select("planes", "agent")
    output = ppo.agent(state)
    distribution = Categorical(logits=output["logits"][k])
    ratio = (distribution.log_prob(batch["action"][k]) - batch["action_log_prob"][k]).exp()
    advantage = batch["advantage"][k].squeeze(-1)
    advantage = (advantage - advantage.mean()) / advantage.std()
    low, high = 1 - settings.clip_epsilon, 1 + settings.clip_epsilon
    surrogate = torch.min(ratio * advantage, ratio.clamp(low, high) * advantage).mean()
    error = (output["state_value"][k] - batch["value_target"][k]).square().mean()
    entropy = distribution.entropy().mean()
    return -surrogate + settings.critic_coeff * error - settings.entropy_coeff * entropy


@pytest.mark.parametrize("observe_agent", [False, True])
def test_loss_and_gradients_equal_the_formulas_per_transition(observe_agent: bool) -> None:
    settings = PPOSettings(horizon=T, epochs=2, max_grad_norm=1e9)
    ppo = learner(copies=2, settings=settings, observe_agent=observe_agent)
    rollout = ppo.collect(generators(0, 1))
    ppo.optimise(rollout)  # the policy moves on, so that ratios differ from one
    plain = sum(plain_loss(ppo, rollout, k, settings) for k in range(2))
    parameters = list(ppo.agent.parameters())
    expected = torch.autograd.grad(plain, parameters)
    metrics = ppo._gradient_step(
        rollout, rollout.select(*ppo.agent.level_keys)[..., 0]
    )  # leaves its gradients on the parameters
    parts = ("objective", "entropy", "critic")
    total = sum(metrics[f"loss_{part}"].sum() for part in parts)
    torch.testing.assert_close(total, plain.detach(), rtol=1e-4, atol=1e-5)
    for parameter, gradient in zip(parameters, expected, strict=True):
        torch.testing.assert_close(parameter.grad, gradient, rtol=1e-3, atol=1e-5)


def test_metrics_tell_how_far_the_policy_moved() -> None:
    """By the formulas: entropy, Schulman's first estimate of the divergence, what was clipped."""
    ppo = learner(copies=2, settings=replace(SETTINGS, learning_rate=3e-3))
    rollout = ppo.collect(generators(0, 1))
    ppo.optimise(rollout)  # the policy moves on, so that ratios differ from one
    level = rollout.select(*ppo.agent.level_keys)[..., 0]
    with torch.no_grad():
        steps = ppo.agent.decode(rollout.copy(), ppo.agent.encode(level))
        policy = ppo.agent.distribution(steps)
    moved = policy.log_prob(rollout["action"]) - rollout["action_log_prob"]
    metrics = ppo._gradient_step(rollout, level)
    torch.testing.assert_close(metrics["entropy"], policy.entropy().mean((1, 2)))
    torch.testing.assert_close(metrics["kl_approx"], -moved.mean((1, 2)), rtol=1e-4, atol=1e-7)
    clipped = (moved.exp() - 1).abs() > ppo.settings.clip_epsilon
    assert clipped.any() and not clipped.all()
    torch.testing.assert_close(metrics["clip_fraction"], clipped.float().mean((1, 2)))
    target = rollout["value_target"].flatten(1)
    residual = target - steps["state_value"].flatten(1)
    explained = [1 - residual[k].var() / target[k].var() for k in range(2)]
    torch.testing.assert_close(metrics["explained_variance"], torch.stack(explained))


@pytest.mark.parametrize("copies", [1, 3])
def test_gradients_are_clipped_per_copy(copies: int) -> None:
    shapes = [(4, 3), (5,), (2, 2, 2)]
    stacked = [torch.nn.Parameter(torch.zeros(copies, *shape)) for shape in shapes]
    scale = torch.tensor([0.01, 1.0, 100.0])[:copies]
    for parameter in stacked:
        parameter.grad = torch.randn(parameter.shape) * scale.view(-1, *[1] * (parameter.ndim - 1))
    apart = [[copy.deepcopy(p.grad[k]) for p in stacked] for k in range(copies)]
    norms = clip_gradients_(stacked, 0.5, copies)
    for k in range(copies):
        own = [torch.nn.Parameter(torch.zeros_like(g)) for g in apart[k]]
        for parameter, gradient in zip(own, apart[k], strict=True):
            parameter.grad = gradient
        torch.testing.assert_close(norms[k], torch.nn.utils.clip_grad_norm_(own, 0.5))
        for parameter, alone in zip(stacked, own, strict=True):
            torch.testing.assert_close(parameter.grad[k], alone.grad)


def a2c(actor, critic) -> A2CLoss:
    return A2CLoss(actor, critic, functional=False, reduction="none", critic_coeff=0.5)


def reinforce(actor, critic) -> ReinforceLoss:
    return ReinforceLoss(actor, critic, functional=False, reduction="none", loss_critic_type="l2")


def plain_a2c(log_prob: Tensor, entropy: Tensor, value: Tensor, batch: TensorDict) -> Tensor:
    """Mnih et al. 2016, section 4, with TorchRL's default coefficient and distance."""
    critic = smooth_l1_loss(value, batch["value_target"])
    return -(log_prob * batch["advantage"]).mean() - 0.01 * entropy.mean() + 0.5 * critic


def plain_reinforce(log_prob: Tensor, _: Tensor, value: Tensor, batch: TensorDict) -> Tensor:
    error = value - batch["value_target"]
    return -(log_prob * batch["advantage"]).mean() + error.square().mean()


@pytest.mark.parametrize(("loss", "formula"), [(a2c, plain_a2c), (reinforce, plain_reinforce)])
def test_another_loss_gives_every_copy_its_own_gradient(loss, formula) -> None:
    settings = replace(SETTINGS, epochs=1, max_grad_norm=1e6)
    ppo = learner(copies=2, settings=settings, loss=loss)
    batch, expected = ppo.collect(generators(0, 1)), []
    before = ppo.snapshot()
    metrics = ppo.optimise(batch)
    gradients = [p.grad.clone() for p in ppo.agent.parameters()]
    ppo.restore(before)
    output = ppo.agent(batch.select("planes", "agent"))
    distribution = Categorical(logits=output["logits"])
    log_prob = distribution.log_prob(batch["action"]).unsqueeze(-1)
    entropy, value = distribution.entropy(), output["state_value"]
    expected = [formula(log_prob[k], entropy[k], value[k], batch[k]) for k in range(2)]
    plain = torch.autograd.grad(sum(expected), list(ppo.agent.parameters()))
    for gradient, other in zip(gradients, plain, strict=True):
        torch.testing.assert_close(gradient, other, rtol=1e-3, atol=1e-6)
    told = sum(metrics[key] for key in metrics.keys() if key.startswith("loss_"))
    torch.testing.assert_close(told, torch.stack(expected).detach(), rtol=1e-4, atol=1e-6)
    assert "clip_fraction" not in metrics.keys()


def test_a_loss_must_not_mix_the_copies() -> None:
    def mean(actor, critic) -> A2CLoss:
        return A2CLoss(actor, critic, functional=False)

    with pytest.raises(ValueError, match="must be \"none\", got 'mean'"):
        learner(loss=mean)


def test_a_rollout_shares_the_levels_memory_and_equals_stepping_by_hand() -> None:
    ppo = learner()
    rollout = ppo.collect(generators(4))
    assert rollout["planes"].shape == (1, P, T, 3, 5, 5)
    assert rollout["planes"].stride(2) == 0
    state = ppo.env.reset()
    for t in range(T):
        assert torch.equal(rollout["agent"][:, :, t], state["agent"])
        state, after = ppo.env.step_and_maybe_reset(state.set("action", rollout["action"][:, :, t]))
        assert torch.equal(rollout["next", "reward"][:, :, t], state["next", "reward"])
        state = after


def test_restore_refuses_what_does_not_fit() -> None:
    ppo = learner(copies=2)
    good = ppo.snapshot()
    name = next(iter(good.keys()))
    narrow, late = good.clone(), good.clone()
    narrow[name]["value"] = narrow[name]["value"][:, :1]
    late[name]["step"] += torch.tensor([0.0, 1.0])
    for bad in (good[[0, 0, 0]], good.exclude(name), narrow):
        with pytest.raises(ValueError, match="another network"):
            ppo.restore(bad)
    with pytest.raises(ValueError, match="different numbers of Adam steps"):
        ppo.restore(late)


def test_entries_may_have_other_names() -> None:
    """Where an environment and a network call things otherwise, the same is learnt."""
    env = TransformedEnv(
        MazeEnv(levels(2), max_steps=5), RenameTransform([], [], ["action"], ["move"])
    )
    torch.manual_seed(3)
    usual = learner(2)
    maps = usual.agent.encoder
    renamed = PPO(
        env,
        ActorCritic(
            TensorDictModule(read_maps, [*maps.out_keys, "agent"], ["scores", "worth"]),
            copy.deepcopy(maps),
            distribution_class=usual.agent.distribution_class,
            copies=2,
            action_key="move",
            log_prob_key="log_prob",
            logits_key="scores",
            value_key="worth",
        ),
        SETTINGS,
    )
    (expected, metrics), (rollout, also) = (
        ppo.update(generators(0, 1)) for ppo in (usual, renamed)
    )
    names = {"move": "action", "log_prob": "action_log_prob", "worth": "state_value"}
    for key in (*names, "advantage", "value_target"):
        assert torch.equal(rollout[key], expected[names.get(key, key)]), key
    assert (also == metrics).all()


def test_a_single_transition_is_not_standardised() -> None:
    one = learner(copies=2, settings=replace(SETTINGS, horizon=1))
    ppo = PPO(MazeEnv(levels(2)[:, :1]), one.agent, one.settings)
    ppo.update(generators(0, 1))
    ppo.check()


def test_more_updates_on_one_batch_recompute_values_and_advantages() -> None:
    settings = replace(SETTINGS, learning_rate=3e-3)
    once, twice = learner(settings=settings), learner(settings=replace(settings, updates=2))
    rollout = once.collect(generators(0))
    first, second = rollout.clone(), rollout.clone()
    level = rollout.select(*once.agent.level_keys)[..., 0]
    for ppo, played, steps in ((once, first, 3), (twice, second, 6)):
        trained = ppo.train(TensorDict({"steps": played, "level": level}))
        assert len(trained["gradient_steps"]) == steps
        # ``twice`` begins as the other does, whose values are then those of its second
        played.update(trained["steps"])
    for part, before in ((second, rollout), (second["next"], rollout["next"])):
        state = TensorDict({"planes": rollout["planes"], "agent": part["agent"]}, rollout.shape)
        present = once.agent(state)["state_value"].detach()
        torch.testing.assert_close(part["state_value"], present, rtol=1e-4, atol=1e-5)
        assert (present - before["state_value"]).abs().max() > 1e-2
    torch.testing.assert_close(
        second["advantage"], hand_gae(second, 0.99, 0.95), rtol=1e-4, atol=1e-5
    )


@pytest.mark.parametrize("copies", [1, 2])
@pytest.mark.parametrize("observe_agent", [False, True])
@pytest.mark.parametrize("clip_value", [None, 0.2])
def test_an_update_never_waits_for_the_device(
    clip_value: float | None, observe_agent: bool, copies: int
) -> None:
    settings = replace(SETTINGS, clip_value=clip_value)
    ppo = learner(copies, settings, observe_agent=observe_agent, batched=True)
    ppo.update(generators(*range(copies)))  # constants are made
    with NoHostReads():
        ppo.env.set_levels(levels_on_hand := ppo.env.levels.clone())
        ppo.update(generators(*range(copies)))
    assert (ppo.env.levels == levels_on_hand).all()


class Crossings(TorchDispatchMode):
    """Counts copies between devices, and tensors of Python's numbers."""

    count = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = func(*args, **(kwargs or {}))
        name = func.overloadpacket.__name__
        if name in ("_to_copy", "copy_"):
            devices = {a.device for a in (*args, result) if isinstance(a, Tensor)}
            self.count += len(devices) > 1
        else:  # of what has dimensions CUDA mixes nothing, where `meta` takes some of it
            devices = {a.device for a in tree_leaves((args, kwargs)) if _has_dimensions(a)}
            assert len(devices) <= 1, f"{func} mixes {devices}"
        self.count += name == "lift_fresh"
        return result


def _has_dimensions(value: Any) -> bool:
    return isinstance(value, Tensor) and value.dim() > 0


def seeing_all() -> PPO:
    agent = map_actor_critic(Population(lambda: UNet(channels=(8, 16), groups=4), 1).to("meta"))
    return PPO(MazeEnv(levels(1).to("meta"), max_steps=5), agent, SETTINGS)


def remembering() -> PPO:
    task = tiny_view_task()
    ppo = task.learner([Streams(0)])
    seen = task.target.sample(4, torch.Generator()).unsqueeze(0).to("meta")
    return PPO(ViewMazeEnv(seen, max_steps=8), ppo.agent.to("meta"), ppo.settings)


@pytest.mark.parametrize("make", [seeing_all, remembering])
def test_everything_in_an_update_stays_on_the_device(
    make: Callable[[], PPO], monkeypatch: pytest.MonkeyPatch
) -> None:
    """On the device ``meta``, which has shapes but no numbers."""
    # TorchRL compares bounds when it makes a spec; autocast does not know the device.
    monkeypatch.setattr(torch, "allclose", lambda *_, **__: True)
    monkeypatch.setattr(torch, "autocast", lambda *_, **__: nullcontext())
    ppo = make()
    ppo.update()  # constants are made, and moved there
    with Crossings() as crossings:
        rollout, metrics = ppo.update()
    assert crossings.count == 1  # the random numbers, which are drawn on the CPU
    leaves = [*rollout.values(True, True), *metrics.values()]
    assert {leaf.device.type for leaf in leaves} == {"meta"}


def test_an_exact_evaluation_stays_on_the_device(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch, "autocast", lambda *_, **__: nullcontext())
    agent = TASK.learner([Streams(0)]).agent.to("meta")
    measured = TASK.target.sample(6, torch.Generator()).to("meta")
    with Crossings() as crossings:
        found = [
            TASK.performance(agent, measured, torch.Generator())["success"],
            TASK.probe(agent, measured),
        ]
    assert crossings.count == 0
    assert {each.device.type for each in found} == {"meta"}


def test_state_made_in_advance_changes_no_step() -> None:
    generator = torch.Generator().manual_seed(0)
    parameters = [[nn.Parameter(torch.ones(3, 5)), nn.Parameter(torch.ones(7))] for _ in range(2)]
    early = complete_adam(parameters[0], 0.1, 1e-5)
    late = torch.optim.Adam(parameters[1], lr=0.1, eps=1e-5, fused=True)
    for _ in range(5):
        slope = torch.randn(3, 5, generator=generator)
        for (used, _), adam in zip(parameters, (early, late), strict=True):
            used.grad = slope.clone()
            adam.step()
    for one, other in zip(*parameters, strict=True):
        assert torch.equal(one, other)
    used, unused = parameters[0]
    assert early.state[used]["step"] == 5 and early.state[unused]["step"] == 0
    assert not torch.equal(used, torch.ones(3, 5)) and torch.equal(unused, torch.ones(7))


def episodes(rewards: torch.Tensor) -> TensorDict:
    """Episodes [K, T] that end with the last step."""
    done = torch.zeros(*rewards.shape, 1, dtype=torch.bool)
    done[:, -1] = True
    following = TensorDict({"reward": rewards.unsqueeze(-1), "done": done}, rewards.shape)
    return TensorDict({"next": following}, rewards.shape)


@pytest.mark.parametrize("gamma", [1.0, 0.9, 1e-6, 1e-8, 5e-324, 0.0])
def test_the_return_to_come_minus_the_mean_of_the_others(gamma: float) -> None:
    rewards = torch.randn(4, 3, generator=torch.Generator().manual_seed(0))
    out = LeaveOneOutBaseline(gamma)(episodes(rewards))
    for k in range(4):
        for t in range(3):
            to_come = [sum(gamma**s * r[t + s] for s in range(3 - t)) for r in rewards]
            others = sum(to_come[j] for j in range(4) if j != k) / 3
            torch.testing.assert_close(out["advantage"][k, t, 0], to_come[k] - others)
            torch.testing.assert_close(out["value_target"][k, t, 0], to_come[k])
