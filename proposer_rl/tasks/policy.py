"""Makes a trained Solver a policy for code of Gymnasium, TorchRL, or torch alone."""

from __future__ import annotations

from os import PathLike
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector.utils import create_empty_array
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torch.utils._pytree import tree_map
from torchrl.data import Binary, Categorical, MultiCategorical, TensorSpec
from torchrl.envs import TensorDictPrimer
from torchrl.envs.utils import ExplorationType, exploration_type

from proposer_rl.learning import PPO
from proposer_rl.models import ActorCritic
from proposer_rl.task import Task
from proposer_rl.tasks.gymnasium.spaces import (
    NUMBERS_ENTRY,
    Layout,
    assembled,
    in_order,
    leaves,
)
from proposer_rl.tasks.gymnasium.task import GymnasiumTask

Space = spaces.Space[Any]
Memory = tuple[Tensor, ...]
BEGINS = "is_init"
EXAMPLES = 2  # rows of the batch that traces an export; a single one would be a constant


class Policy(TensorDictModuleBase):
    """A trained Solver that acts on observations of the environment's own space.

    :meth:`predict` works as in Stable-Baselines3's policies, and :meth:`save` writes a file that
    torch alone can load. As a module this is a TorchRL actor: it reads the entries of TorchRL's
    ``GymEnv(..., categorical_action_encoding=True)``, or those of the task's own TorchRL
    environment, of any batch shape, and writes ``action``. That is the most probable action, or a
    sampled one under ``set_exploration_type(ExplorationType.RANDOM)``, as in TorchRL's collectors.
    No gradients flow.

    Args:
        agent: one Solver, with ``copies=1``.
        observation_space, action_space: of one environment, without a batch.
        plain: whether a :class:`~proposer_rl.tasks.gymnasium.spaces.Layout` converts between these
            spaces and the agent; else the agent reads each part by its name, and its actions are
            those of the space.
    """

    def __init__(
        self, agent: ActorCritic, observation_space: Space, action_space: Space, *, plain: bool
    ) -> None:
        super().__init__()
        self.agent = agent
        self.observation_space, self.action_space = observation_space, action_space
        self._layout = Layout(observation_space, action_space) if plain else None
        self._observed = [_key(name) or NUMBERS_ENTRY for name, _ in leaves(observation_space)]
        acted = [_key(name, "action") for name, _ in leaves(action_space)]
        remembered = [BEGINS, *agent.memory] if agent.memory else []
        self.in_keys = [*self._observed, *remembered]
        self.out_keys = [*acted, *agent.memory_keys]

    def predict(
        self,
        observation: Any,
        state: tuple[Any, ...] | None = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[Any, tuple[Any, ...] | None]:
        """Returns actions for an observation, or for a batch of them from a vector environment.

        Args:
            observation: of the observation space: numbers, arrays, dictionaries and tuples.
            state: the memory that the last call returned; None at the beginning of episodes.
            episode_start: whether an episode begins, which clears its memory: a truth value or bool
                [n]; None for no.
            deterministic: whether to take the most probable action, or to sample one by torch's
                default generator.

        Returns:
            An action of the action space, or a batch of actions for a vector environment; and the
            memory, None for a Solver without.

        Raises:
            ValueError: if a part of the observation has another shape than its space.
        """
        space = self.observation_space
        parts = zip(leaves(space), in_order(space, observation), strict=True)
        shown = [torch.tensor(np.asarray(seen, part.dtype)) for (_, part), seen in parts]
        batch = self._batch(shown)
        begins = torch.as_tensor(False if episode_start is None else episode_start).flatten()
        begins = begins.expand(batch.numel()).reshape(batch)
        memory = None if state is None else tuple(torch.as_tensor(part) for part in state)
        actions, memory = self.act(shown, memory, begins, sample=not deterministic)
        values: list[Any] = [action.cpu().numpy() for action in actions]
        if not batch:
            kinds = zip(leaves(self.action_space), values, strict=True)
            values = [int(v) if isinstance(kind, spaces.Discrete) else v for (_, kind), v in kinds]
        after = None if memory is None else tuple(part.cpu().numpy() for part in memory)
        return assembled(self.action_space, iter(values)), after

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes ``action`` into a tensordict [*B], and the memory after the step below ``next``.

        Raises:
            ValueError: if a part of the observation has another shape than its space.
        """
        shown = [tensordict[key] for key in self._observed]
        self._batch(shown, tensordict.batch_size)
        memory = tuple(tensordict[key] for key in self.agent.memory) or None
        begins = tensordict[BEGINS].squeeze(-1) if memory else None
        sample = exploration_type() == ExplorationType.RANDOM
        actions, memory = self.act(shown, memory, begins, sample=sample)
        for key, value in zip(self.out_keys, [*actions, *(memory or ())], strict=True):
            tensordict.set(key, value)
        return tensordict

    def primer(self) -> TensorDictPrimer:
        """Returns the TorchRL transform for the memory, to be put after ``InitTracker``."""
        return self.agent.primer()

    def save(self, path: str | PathLike[str], *, deterministic: bool = True) -> None:
        """Saves the policy by ``torch.export``, for any batch size.

        ``torch.export.load(path).module()`` takes a batch of observations as tensors in the
        structure of the observation space, and returns actions in that of the action space. With
        memory it also takes the memory, two tensors [n, M] that are zero at first, and whether
        episodes begin, bool [n], and returns ``(action, memory)``.

        Args:
            path: of the file, usually with the suffix ``.pt2``.
            deterministic: as in :meth:`predict`.
        """
        device = next(self.parameters()).device
        observation = create_empty_array(self.observation_space, EXAMPLES)
        given: tuple[Any, ...] = (observation,)
        if self.agent.memory:
            memory = self.agent.no_memory(TensorDict({}, [EXAMPLES]))
            given += (tuple(memory.values()), np.zeros(EXAMPLES, np.bool_))
        given = tree_map(lambda part: torch.as_tensor(part, device=device), given)
        module = _Exported(self, sample=not deterministic)
        module(*given)  # so that constants are computed before the trace
        sizes = tree_map(lambda _: {0: torch.export.Dim("batch")}, given)
        torch.export.save(torch.export.export(module, given, dynamic_shapes=sizes), path)

    @torch.no_grad()
    def act(
        self, shown: list[Tensor], memory: Memory | None, begins: Tensor | None, *, sample: bool
    ) -> tuple[list[Tensor], Memory | None]:
        """Returns the parts of actions [*B], and the memory after the step.

        Args:
            shown: parts of observations [*B, ...], in the order of the space's parts.
            memory: before the step, [*B, M] each; None for the first step.
            begins: whether episodes begin, bool [*B]; None without memory.
            sample: whether to sample the action.
        """
        agent, batch = self.agent, self._batch(shown)
        if self._layout is None:
            entries = dict(zip(self._observed, shown, strict=True))
        else:
            entries = self._layout.entries(shown)
        if agent.memory:
            assert begins is not None
            entries[BEGINS] = begins.unsqueeze(-1)
            if memory is None:
                memory = tuple(agent.no_memory(TensorDict({}, batch)).values())
            entries |= dict(zip(agent.memory, memory, strict=True))
        device = next(self.parameters()).device
        rows = {  # [1, n, ...]
            name: part.to(device)[None].flatten(0, len(batch))[None]
            for name, part in entries.items()
        }
        state = agent(TensorDict(rows, next(iter(rows.values())).shape[:2]))
        distribution = agent.distribution(state)
        drawn = distribution.sample() if sample else distribution.mode
        after = [state.get(key) for key in agent.memory_keys]
        action, *after = (part[0].reshape((*batch, *part.shape[2:])) for part in (drawn, *after))
        own = [action] if self._layout is None else self._layout.own_actions(action)
        return own, tuple(after) or None

    def _batch(self, shown: list[Tensor], batch: torch.Size | None = None) -> torch.Size:
        """Returns the batch shape [*B] of an observation's parts, and checks their shapes."""
        parts = list(leaves(self.observation_space))
        if batch is None:
            batch = shown[0].shape[: shown[0].ndim - len(parts[0][1].shape)]
        for (name, part), seen in zip(parts, shown, strict=True):
            if seen.shape != (*batch, *part.shape):
                raise ValueError(
                    f"observation{name and f', its part {name}'}: must have the shape "
                    f"{list(part.shape)} of {part}, after that of a batch, got {list(seen.shape)}"
                )
        return batch


def policy_of(task: Task, learner: PPO) -> Policy:
    """Returns the only Solver of a task's learner as a policy."""
    if isinstance(task, GymnasiumTask):
        return Policy(learner.agent, *task.own_spaces(), plain=True)
    env, agent = learner.env, learner.agent
    names = [key for key in agent.in_keys if key not in (BEGINS, *agent.memory)]
    seen = {name: _space(env.observation_spec[name]) for name in names}
    space = seen[NUMBERS_ENTRY] if names == [NUMBERS_ENTRY] else spaces.Dict(seen)
    return Policy(agent, space, _space(env.full_action_spec[agent.action_key]), plain=False)


def _space(spec: TensorSpec) -> Space:
    """Returns the space of one element of a spec [K, P, ...]."""
    one = spec[0, 0]
    if isinstance(one, MultiCategorical):
        return spaces.MultiDiscrete(one.nvec.cpu().numpy())
    if isinstance(one, Categorical):
        return spaces.Discrete(one.n)
    dtype: Any = torch.empty(0, dtype=one.dtype).numpy().dtype.type
    ends = (0, 1) if isinstance(one, Binary) else (one.space.low.cpu(), one.space.high.cpu())
    low, high = (np.broadcast_to(end, tuple(one.shape)) for end in ends)
    return spaces.Box(low, high, dtype=dtype)


def _key(name: str, *before: str) -> Any:
    """Returns the key of a tensordict for a dotted name."""
    key = (*before, *filter(None, name.split(".")))
    return key[0] if len(key) == 1 else key or None


class _Exported(nn.Module):
    """A policy on tensors in the structure of its spaces, which torch can export."""

    def __init__(self, policy: Policy, *, sample: bool) -> None:
        super().__init__()
        self.policy, self.sample = policy, sample

    def forward(
        self, observation: Any, memory: Memory | None = None, episode_start: Tensor | None = None
    ) -> Any:
        shown = list(in_order(self.policy.observation_space, observation))
        actions, after = self.policy.act(shown, memory, episode_start, sample=self.sample)
        action = assembled(self.policy.action_space, iter(actions))
        return action if after is None else (action, after)
