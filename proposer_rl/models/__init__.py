"""Networks and actor-critics of Solver and Proposer, which know tensors and no environment."""

from proposer_rl.models.actor_critic import ActorCritic as ActorCritic
from proposer_rl.models.actor_critic import categorical as categorical
from proposer_rl.models.actor_critic import distribution_of as distribution_of
from proposer_rl.models.actor_critic import draw_at as draw_at
from proposer_rl.models.actor_critic import joint_categorical as joint_categorical
from proposer_rl.models.actor_critic import normal as normal
from proposer_rl.models.actor_critic import one_copy as one_copy
from proposer_rl.models.actor_critic import orthogonal_ as orthogonal_
from proposer_rl.models.actor_critic import uniform_noise as uniform_noise
from proposer_rl.models.grids import UNet as UNet
from proposer_rl.models.grids import cell_logits as cell_logits
from proposer_rl.models.grids import cell_maps as cell_maps
from proposer_rl.models.grids import map_actor_critic as map_actor_critic
from proposer_rl.models.memory import MemoryNetwork as MemoryNetwork
from proposer_rl.models.memory import memory_actor_critic as memory_actor_critic
from proposer_rl.models.population import Population as Population
from proposer_rl.models.population import available_cores as available_cores
from proposer_rl.models.population import check_torch_defaults as check_torch_defaults
from proposer_rl.models.population import use_device as use_device
from proposer_rl.models.proposer import MapEncoder as MapEncoder
from proposer_rl.models.proposer import MixtureHead as MixtureHead
from proposer_rl.models.proposer import ProblemHead as ProblemHead
from proposer_rl.models.proposer import ProposerNetwork as ProposerNetwork
from proposer_rl.models.proposer import proposer_actor_critic as proposer_actor_critic
