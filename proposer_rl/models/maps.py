"""An actor-critic over whole grids: a network whose maps are read at the agent's cell."""

from __future__ import annotations

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn

from proposer_rl.models.actor_critic import ActorCritic, categorical
from proposer_rl.models.population import Population

AT_ONCE = 2**17  # cells of grids that go through a network together


def map_actor_critic(network: nn.Module, *, per_step: bool = False) -> ActorCritic:
    """Actor-critic of a network that maps planes [*B, C, H, W] to action and value maps.

    It reads ``planes``, and the agent's row and column in ``agent``, int64 [*B, 2].

    Args:
        network: returns logits [*B, A, H, W] and values [*B, 1, H, W]; a
            :class:`~proposer_rl.models.Population` of such networks takes B = [K, ...].
        per_step: True if the planes change from step to step (the agent is drawn on one of them);
            False if they belong to the level, which then costs one forward pass per rollout.

    Example:
        >>> from proposer_rl import UNet
        >>> agent, cells = map_actor_critic(UNet(channels=(8, 8))), torch.zeros(5, 2).long()
        >>> state = TensorDict({"planes": torch.rand(5, 3, 6, 6), "agent": cells}, [5])
        >>> agent(state)["logits"].shape
        torch.Size([5, 4])
    """
    maps = TensorDictModule(network, ["planes"], ["policy_map", "value_map"])
    head = TensorDictModule(
        read_maps, ["policy_map", "value_map", "agent"], ["logits", "state_value"]
    )
    copies = network.copies if isinstance(network, Population) else None
    encoder = None if per_step else maps
    if per_step:
        head = TensorDictSequential(maps, head, selected_out_keys=["logits", "state_value"])
    return ActorCritic(head, encoder, distribution_class=categorical, copies=copies)


def read_maps(policy_map: Tensor, value_map: Tensor, agent: Tensor) -> tuple[Tensor, Tensor]:
    """Read logits and values at the agents' cells.

    Args:
        policy_map: float [*B, A, H, W].
        value_map: float [*B, 1, H, W].
        agent: int64 rows and columns, [*B, 2] or [*B, *T, 2] for several steps of each level.

    Returns:
        Logits [*B, *T, A] and values [*B, *T, 1].
    """
    maps = torch.cat([policy_map, value_map], -3).flatten(-2)  # [*B, A + 1, H * W]
    levels = maps.shape[:-2]
    cell = agent[..., 0] * policy_map.shape[-1] + agent[..., 1]  # [*B, *T]
    index = cell.reshape(*levels, 1, -1).expand(*levels, maps.shape[-2], -1)
    read = maps.gather(-1, index).transpose(-1, -2).reshape(*cell.shape, -1)  # [*B, *T, A + 1]
    return read[..., :-1], read[..., -1:]


def cell_logits(agent: ActorCritic, planes: Tensor, *, gradients: bool = False) -> Tensor:
    """Action logits at every cell of levels: what the agent would do wherever it stood.

    Args:
        agent: from :func:`map_actor_critic`.
        planes: the levels without the agent, float [*B, C, H, W], with replicas [K, *B, C, H, W].
        gradients: whether they flow to the agent's parameters.

    Returns:
        float [*B, A, H, W].
    """
    return cell_maps(agent, planes, gradients=gradients)[0]


def cell_maps(
    agent: ActorCritic, planes: Tensor, *, gradients: bool = False
) -> tuple[Tensor, Tensor]:
    """Action logits and values at every cell of levels; the arguments are :func:`cell_logits`'.

    Returns:
        Logits float [*B, A, H, W] and the critic's values float [*B, 1, H, W].
    """
    batch, (height, width) = planes.shape[:-3], planes.shape[-2:]
    with torch.set_grad_enabled(gradients):
        if agent.encoder is not None:
            (planes_key,) = agent.level_keys
            context = agent.encode(TensorDict({planes_key: planes}, batch))
            return context["policy_map"], context["value_map"]
        planes_key, agent_key = agent.step_keys
        rows, columns = (torch.arange(side, device=planes.device) for side in (height, width))
        outputs = []
        at_once = max(AT_ONCE // (batch.numel() * height * width), 1)
        for cells in torch.cartesian_prod(rows, columns).split(at_once):  # [n, 2]
            at = cells.expand(*batch, *cells.shape)
            shown = planes.unsqueeze(-4).expand(*at.shape[:-1], *planes.shape[-3:])
            drawn = planes.new_zeros(len(cells), height * width)
            drawn.scatter_(1, cells[:, :1] * width + cells[:, 1:], 1.0)
            drawn = drawn.view(-1, 1, height, width).expand(*at.shape[:-1], 1, height, width)
            seen = {planes_key: torch.cat([shown, drawn], -3), agent_key: at}
            output = agent(TensorDict(seen, at.shape[:-1]))
            outputs.append((output["logits"], output["state_value"]))
        logits, values = (
            torch.cat(each, -2).transpose(-1, -2).unflatten(-1, (height, width))
            for each in zip(*outputs, strict=True)
        )
        return logits, values
