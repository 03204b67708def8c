"""The actor-critic with memory: through time at once, step by step, and against torch's LSTM."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.collectors import Collector
from torchrl.envs import TransformedEnv
from torchrl.modules import set_recurrent_mode
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from proposer_rl.models import ActorCritic, MemoryNetwork, Population, memory, memory_actor_critic
from proposer_rl.models.memory import MEMORY
from proposer_rl.streams import Streams
from tests.tiny import TASK, tiny_view_task

K, N, T, F, M, A = 3, 4, 9, 5, 6, 2


def network() -> MemoryNetwork:
    return MemoryNetwork(nn.Linear(F, F), F, A, memory=M, head=7)


def agent(copies: int = K, **how: Any) -> ActorCritic:
    torch.manual_seed(0)
    return memory_actor_critic(Population(network, copies, **how), ["x"], M)


def steps(seed: int = 0, begins: float = 0.3) -> TensorDict:
    draw = torch.Generator().manual_seed(seed)
    entries = {
        "x": torch.randn(K, N, T, F, generator=draw),
        "is_init": torch.rand(K, N, T, 1, generator=draw) < begins,
        **{key: torch.randn(K, N, T, M, generator=draw) for key in MEMORY},
    }
    return TensorDict(entries, [K, N, T])


def through_time(actor_critic: ActorCritic, batch: TensorDict) -> TensorDict:
    with set_recurrent_mode(True):
        return actor_critic(batch.clone())


def step_by_step(actor_critic: ActorCritic, batch: TensorDict) -> TensorDict:
    """One call for each step, the memory carried by hand."""
    taken, memory = [], batch[:, :, 0].select(*MEMORY)
    for t in range(T):
        taken.append(actor_critic(batch[:, :, t].clone().update(memory)))
        memory = taken[-1]["next"].select(*MEMORY)
    return torch.stack(taken, 2)  # type: ignore[return-value]


def test_without_episodes_it_is_torchs_lstm() -> None:
    torch.manual_seed(1)
    ours, lstm = network(), nn.LSTM(F, M, batch_first=True)
    lstm.load_state_dict({f"{name}_l0": value for name, value in ours.cell.state_dict().items()})
    x, memory = torch.randn(N, T, F), torch.randn(2, N, M)
    begins = torch.zeros(N, T, 1, dtype=torch.bool)
    logits, _, hidden, cell = ours(begins, *memory, x)
    expected, last = lstm(ours.encoder(x), tuple(m.unsqueeze(0) for m in memory))
    torch.testing.assert_close(hidden, expected)
    torch.testing.assert_close(cell[:, -1], last[1][0])
    torch.testing.assert_close(logits, ours.policy(expected))
    weights = torch.randn(N, T, A)
    (logits * weights).sum().backward()
    (ours.policy(expected) * weights).sum().backward()
    for name, parameter in lstm.named_parameters():
        torch.testing.assert_close(
            getattr(ours.cell, name.removesuffix("_l0")).grad, parameter.grad
        )


def test_gradients_through_time_and_resets_are_slopes() -> None:
    torch.manual_seed(2)
    small = network().double()
    begins = torch.rand(N, 4, 1) < 0.4
    assert begins.any() and not begins.all()

    def worth(x: Tensor, hidden: Tensor, cell: Tensor) -> tuple[Tensor, Tensor]:
        return small(begins, hidden, cell, x)[:2]

    inputs = [torch.randn(s, dtype=torch.double, requires_grad=True) for s in ((N, 4, F), (N, M))]
    assert torch.autograd.gradcheck(worth, (*inputs, inputs[1].detach().clone()))


@pytest.mark.parametrize("how", [{}, {"batched": True}], ids=["one by one", "batched"])
def test_through_time_is_step_by_step(how: dict[str, Any]) -> None:
    actor_critic, batch = agent(**how), steps()
    with torch.no_grad():
        at_once, one_by_one = through_time(actor_critic, batch), step_by_step(actor_critic, batch)
    for key in actor_critic.out_keys:
        torch.testing.assert_close(at_once[key], one_by_one[key], rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("precision", ["fp32", "bf16"])
def test_compiled_steps_are_those_of_python(
    precision: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def trained_on() -> list[Tensor]:
        actor_critic = agent(precision=precision)
        out = through_time(actor_critic, steps())
        (out["logits"].square().sum() + out["next", MEMORY[1]].sum()).backward()
        slopes = [p.grad for p in actor_critic.parameters() if p.grad is not None]
        return [out["logits"].detach(), *slopes]

    compiled = [trained_on() for _ in range(3)]  # the first ones are profiled
    monkeypatch.setattr(memory, "_compiled", lambda steps, on: steps)
    for ours in compiled:
        for one, other in zip(ours, trained_on(), strict=True):
            torch.testing.assert_close(one, other, rtol=0, atol=0)


def test_an_episode_knows_nothing_of_the_one_before() -> None:
    actor_critic, batch = agent(), steps(begins=0.0)
    batch["is_init"][:, :, 5] = True
    other = batch.clone()
    other["x"][:, :, :5], other[MEMORY[0]][:, :, 0] = 0.0, 3.0
    with torch.no_grad():
        one, another = (through_time(actor_critic, b)["logits"] for b in (batch, other))
    assert torch.equal(one[:, :, 5:], another[:, :, 5:])
    assert not torch.equal(one[:, :, 4], another[:, :, 4])


@torch.no_grad()
def test_with_its_primer_it_remembers_in_rollouts_and_collectors_of_torchrl() -> None:
    solvers = tiny_view_task().learner([Streams(0, k) for k in range(2)])
    env, actor = TransformedEnv(solvers.env, solvers.agent.primer()), solvers.agent.actor
    rollout = env.rollout(20, actor(sample=True), break_when_any_done=False)
    frames = env.batch_size.numel() * 20
    collector = Collector(env, actor(), frames_per_batch=frames, total_frames=frames)
    for steps in (rollout, *collector):
        assert steps["is_init"][:, :, 1:].any() and steps["recurrent_state_h"].any()
        again = through_time(solvers.agent, steps.select(*solvers.agent.in_keys))
        torch.testing.assert_close(steps["logits"], again["logits"])
    # Where nothing says how actions are drawn, only an actor that samples explores.
    assert (rollout["action"] != rollout["logits"].argmax(-1)).any()
    greedy = env.rollout(3, actor(), break_when_any_done=False)
    assert (greedy["action"] == greedy["logits"].argmax(-1)).all()


@pytest.mark.parametrize("task", [TASK, tiny_view_task()], ids=["maps", "memory"])
def test_advantages_and_losses_of_torchrl_take_it(task: Any) -> None:
    """Values after each step are those of its own episode, also where that was cut off."""
    agent = (solvers := task.learner([Streams(0, k) for k in range(2)])).agent
    env = TransformedEnv(solvers.env, agent.primer()) if agent.memory else solvers.env
    with torch.no_grad():
        rollout = env.rollout(20, agent.actor(sample=True), break_when_any_done=False)
        agent(rollout["next"])
    values, after = (part["state_value"].squeeze(-1) for part in (rollout, rollout["next"]))
    done = rollout["next", "done"].squeeze(-1)
    torch.testing.assert_close(after[..., :-1][~done[..., :-1]], values[..., 1:][~done[..., :-1]])
    end = int(done[0, 0].byte().argmax())
    last = rollout["next"][..., end : end + 1].select(*agent.in_keys)
    whole = torch.cat([rollout[..., : end + 1].select(*agent.in_keys), last], -1)
    with set_recurrent_mode(True), torch.no_grad():
        torch.testing.assert_close(agent(whole)["state_value"][0, 0, -1, 0], after[0, 0, end])
    GAE(gamma=0.9, lmbda=0.9, value_network=None)(rollout)
    with set_recurrent_mode(True):
        losses = ClipPPOLoss(agent.actor(), agent)(rollout)
    sum(losses[name] for name in losses.keys() if name.startswith("loss_")).backward()
    assert all(parameter.grad.any() for parameter in agent.parameters())
    assert abs(float(losses["kl_approx"])) < 1e-5
