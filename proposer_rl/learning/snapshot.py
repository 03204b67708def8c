"""All that training changes of an agent, taken out and put back: weights, moments, Adam's state."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torch.optim import Adam

from proposer_rl.models import ActorCritic


def complete_adam(parameters: Sequence[nn.Parameter], learning_rate: float, eps: float) -> Adam:
    """Returns torch's Adam with its state, which it otherwise makes at its first step.

    On a GPU its learning rate is a tensor there, so that a graph of its steps reads what it is set
    to (:func:`set_learning_rate`).
    """
    rate: float | Tensor = learning_rate
    on_gpu = parameters[0].is_cuda
    if on_gpu:
        rate = torch.tensor(learning_rate, device=parameters[0].device)
    adam = Adam(parameters, lr=rate, eps=eps, fused=True, capturable=on_gpu)
    for parameter in parameters:
        adam.state[parameter] = {
            "step": torch.zeros((), device=parameter.device),
            "exp_avg": torch.zeros_like(parameter),
            "exp_avg_sq": torch.zeros_like(parameter),
        }
    return adam


def set_learning_rate(adam: Adam, learning_rate: float) -> None:
    """Sets the learning rate of the next steps."""
    for group in adam.param_groups:
        if isinstance(group["lr"], Tensor):
            group["lr"].fill_(learning_rate)
        else:
            group["lr"] = learning_rate


def take_snapshot(agent: ActorCritic, adam: Adam) -> TensorDict:
    """Returns a copy of weights and Adam's state, batch [K] with replicas and [] without."""
    batch = _batch(agent)
    entries: dict[str, TensorDict] = {}
    for name, value in agent_values(agent).items():
        entry = {"value": value.detach().clone()}
        if value in adam.state:
            state = adam.state[value]
            entry |= {key: state[key].clone() for key in ("exp_avg", "exp_avg_sq")}
            entry["step"] = state["step"].expand(batch).clone()
        entries[name] = TensorDict(entry, batch)
    return TensorDict(entries, batch)


def restore_snapshot(agent: ActorCritic, adam: Adam, snapshot: TensorDictBase) -> int:
    """Restores a snapshot of as many replicas (in place).

    Returns:
        The number of Adam's steps so far.

    Raises:
        ValueError: if it is of another network, or its replicas differ in Adam's steps.
    """
    load_agent(agent, snapshot)
    parameters = dict(agent.named_parameters())
    steps = torch.stack([snapshot[name, "step"].flatten() for name in parameters])
    # The one question here that waits for the device.
    if not bool((steps == steps[:, :1]).all()):
        raise ValueError("the snapshot's copies have made different numbers of Adam steps")
    for name, parameter in parameters.items():
        entry, state = snapshot[name], adam.state[parameter]
        state["exp_avg"].copy_(entry["exp_avg"])
        state["exp_avg_sq"].copy_(entry["exp_avg_sq"])
        state["step"].copy_(entry["step"].flatten()[0])
    return int(steps.max())  # of frozen parameters there are none


def _batch(agent: ActorCritic) -> torch.Size:
    return torch.Size([] if agent.copies is None else [agent.copies])


def agent_values(agent: ActorCritic) -> dict[str, Tensor]:
    """Returns an agent's weights, and moments of its observations and rewards, by name."""
    learnt = agent.normalization
    moments = () if learnt is None else learnt.named_buffers("normalization")
    return dict([*agent.named_parameters(), *moments])


def agent_weights(agent: ActorCritic) -> TensorDict:
    """Returns a copy of an agent's weights and moments, batch [], for :func:`load_agent`."""
    values = agent_values(agent)
    return TensorDict({name: {"value": value.detach().clone()} for name, value in values.items()})


def load_agent(agent: ActorCritic, snapshot: TensorDictBase) -> None:
    """Loads the weights and moments of a snapshot into an agent (in place).

    Raises:
        ValueError: if they belong to another network.
    """
    values = agent_values(agent)
    shapes = {name: value.shape for name, value in values.items()}
    if shapes != {name: snapshot[name, "value"].shape for name in snapshot.keys()}:
        raise ValueError("the snapshot belongs to another network: its parameters differ")
    for name, value in values.items():
        value.data.copy_(snapshot[name, "value"])
