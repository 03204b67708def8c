"""Networks over whole grids: a U-Net, and reading its maps at the agent's cell."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torch.nn import functional as F

from proposer_rl.models.actor_critic import ActorCritic, categorical, orthogonal_
from proposer_rl.models.population import Conv3x3, Population

LARGEST_MATRIX = 2**22  # weights of an interpolation, such as to a 64x64 grid from its half
CELLS_PER_PASS = 2**17  # cells that go through a network together, if each has its own planes


class DoubleConv(nn.Sequential):
    """A 3x3 convolution, GroupNorm and ReLU, twice."""

    def __init__(self, in_channels: int, out_channels: int, groups: int) -> None:
        super().__init__(
            Conv3x3(in_channels, out_channels),
            nn.GroupNorm(groups, out_channels),
            nn.ReLU(inplace=True),
            Conv3x3(out_channels, out_channels),
            nn.GroupNorm(groups, out_channels),
            nn.ReLU(inplace=True),
        )


class UNet(nn.Module):
    """A fully convolutional encoder-decoder with skip connections and 1x1 output heads.

    Max-pooling on the way down, bilinear interpolation to the skip's size on the way up (so that
    any height and width works), a 1x1 head per group of output maps (Ronneberger et al. 2015; the
    depth, the channels and the heads are those of the paper's Solver).

    Args:
        in_channels: planes of the input.
        head_channels: maps of each head, e.g. ``(4, 1)`` for action logits and a value.
        channels: channels of each level, from full resolution to the coarsest.
        groups: groups of every GroupNorm; divides each of ``channels``.
        head_gains: gain of each head's orthogonal initialisation.

    Example:
        >>> network = UNet(channels=(8, 16))
        >>> logits, value = network(torch.zeros(2, 3, 9, 13))
        >>> logits.shape, value.shape
        (torch.Size([2, 4, 9, 13]), torch.Size([2, 1, 9, 13]))
    """

    def __init__(
        self,
        in_channels: int = 3,
        head_channels: Sequence[int] = (4, 1),
        channels: Sequence[int] = (64, 128, 256),
        groups: int = 8,
        head_gains: Sequence[float] = (1.0, 1.0),
    ) -> None:
        super().__init__()
        inputs = [in_channels, *channels[:-1]]
        self.down = nn.ModuleList(
            DoubleConv(i, o, groups) for i, o in zip(inputs, channels, strict=True)
        )
        self.up = nn.ModuleList(
            DoubleConv(deep + skip, skip, groups)
            for deep, skip in zip(channels[:0:-1], channels[-2::-1], strict=True)
        )
        self.heads = nn.ModuleList(nn.Conv2d(channels[0], maps, 1) for maps in head_channels)
        orthogonal_(self)
        for head, gain in zip(self.heads, head_gains, strict=True):
            orthogonal_(head, gain)

    def forward(self, planes: Tensor) -> tuple[Tensor, ...]:
        """Maps ``planes`` [*B, in_channels, H, W] to one tensor [*B, maps, H, W] for each head."""
        leading = planes.shape[:-3]
        x = planes.reshape(-1, *planes.shape[-3:])
        # Channels last, by permutation: the memory format itself is not available under vmap.
        x = x.permute(0, 2, 3, 1).contiguous().permute(0, 3, 1, 2)
        skips = []
        for i, block in enumerate(self.down):
            x = block(F.max_pool2d(x, 2) if i else x)
            skips.append(x)
        skips.pop()
        for block in self.up:
            skip = skips.pop()
            x = block(torch.cat([skip, upsample(x, skip.shape[-2:])], 1))
        maps = (head(x) for head in self.heads)
        return tuple(m.reshape(*leading, *m.shape[1:]) for m in maps)


def upsample(maps: Tensor, size: Sequence[int]) -> Tensor:
    """Interpolates maps [B, C, h, w] bilinearly to [B, C, H, W], as ``F.interpolate`` does.

    This is one product with a constant matrix: on small maps its backward pass takes a fraction of
    the kernel's time, and the result stays in the channels-last layout. If the matrix were large,
    the kernel is used instead.
    """
    height, width = size
    if height * width * maps.shape[-2:].numel() > LARGEST_MATRIX:
        return F.interpolate(maps, (height, width), mode="bilinear")
    pixels = maps.permute(0, 2, 3, 1).flatten(1, 2)  # [B, h * w, C]
    weights = _interpolation(*maps.shape[-2:], height, width, maps.device).to(maps.dtype)
    return (weights @ pixels).unflatten(1, (height, width)).permute(0, 3, 1, 2)


@lru_cache(maxsize=64)
def _interpolation(
    height: int, width: int, to_height: int, to_width: int, device: torch.device
) -> Tensor:
    """Returns the weight of every input pixel in every output pixel, float32 [H * W, h * w]."""
    with torch.inference_mode(False), torch.autocast(device.type, enabled=False):
        pixels = torch.eye(height * width, device=device).unflatten(1, (1, height, width))
        columns = F.interpolate(pixels, (to_height, to_width), mode="bilinear")
        return columns.flatten(1).T.contiguous()


def map_actor_critic(network: nn.Module, *, per_step: bool = False) -> ActorCritic:
    """Makes an actor-critic of a network from planes [*B, C, H, W] to action and value maps.

    It reads ``planes``, and the agent's row and column in ``agent``, int64 [*B, 2].

    Args:
        network: returns logits [*B, A, H, W] and values [*B, 1, H, W]; a
            :class:`~proposer_rl.models.Population` of such networks takes B = [K, ...].
        per_step: True if the planes change from step to step (the agent is drawn on one of them);
            False if they belong to the level, so that a rollout costs one forward pass.

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
    """Reads logits and values at the agents' cells.

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
    """Returns action logits at every cell of levels, as if the agent stood there.

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
    """Returns action logits and values at every cell of levels; see :func:`cell_logits`.

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
        at_once = max(CELLS_PER_PASS // (batch.numel() * height * width), 1)
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
