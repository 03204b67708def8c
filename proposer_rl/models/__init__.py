"""Networks and actor-critics of both agents; they know tensors and no environment."""

from proposer_rl.models.actor_critic import (
    ActorCritic,
    categorical,
    draw,
    joint_categorical,
    normal,
    uniform_noise,
)
from proposer_rl.models.maps import cell_logits, cell_maps, map_actor_critic, read_maps
from proposer_rl.models.memory import MemoryNetwork, memory_actor_critic
from proposer_rl.models.population import Population, available_cores, use_device
from proposer_rl.models.proposer import (
    MapEncoder,
    MixtureHead,
    ProblemHead,
    ProposerNetwork,
    fourier_encoding,
    proposer_actor_critic,
)
from proposer_rl.models.unet import UNet, orthogonal_

__all__ = [
    "ActorCritic",
    "MapEncoder",
    "MemoryNetwork",
    "MixtureHead",
    "Population",
    "ProblemHead",
    "ProposerNetwork",
    "UNet",
    "available_cores",
    "categorical",
    "cell_logits",
    "cell_maps",
    "draw",
    "fourier_encoding",
    "joint_categorical",
    "map_actor_critic",
    "memory_actor_critic",
    "normal",
    "orthogonal_",
    "proposer_actor_critic",
    "read_maps",
    "uniform_noise",
    "use_device",
]
