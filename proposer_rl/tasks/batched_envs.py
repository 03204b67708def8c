"""Makes tasks of your own environments that step a batch of levels in torch."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, NamedTuple

import torch
from annotated_types import Ge
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.data import Binary, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from proposer_rl.learning import SolverSettings
from proposer_rl.models import check_torch_defaults, population
from proposer_rl.settings import ArgumentError, signed, within
from proposer_rl.task import ComputeContext, Levels, Task
from proposer_rl.tasks.gymnasium.networks import NetworkSettings, solver_network
from proposer_rl.tasks.gymnasium.player import import_object
from proposer_rl.tasks.parameters import SEED
from proposer_rl.tasks.ranges import RangeSettings, spaces

SHIFT, MIX = (30, 27, 31), (-0x40A7B892E31B1A47, -0x6B2FB644ECCEEE15)  # SplitMix64's finalizer
STEP, ENTRY = -0x61C8864680B583EB, 0x632BE59BD9B4E019  # odd, and without a pattern
UNIT = 2.0**-24  # between neighbouring numbers of :func:`uniform`

Values = Mapping[str, Tensor]
"""A level's parameters by name, [*B] each: float, or int64 where the values are whole numbers."""


class Step(NamedTuple):
    """The result of a step, in an environment of batch shape [*B].

    Attributes:
        state: the next state, float [*B, S].
        reward: float [*B].
        terminated: bool [*B].
        success: whether the episode is a success if it ends here, bool [*B].
    """

    state: Tensor
    reward: Tensor
    terminated: Tensor
    success: Tensor


@signed
class BatchedEnv(EnvBase):
    """The base of environments whose levels are named numbers, and that step a batch [*B] at once.

    Your own class sets the sizes (``state_size``, ``observation_size``, and ``actions`` or
    ``forces``) and defines :meth:`advance`; :meth:`begin` if a first state is more than zeros; and
    :meth:`observe` if observations are not just the state. These methods must not keep anything
    between calls. An episode is truncated after ``max_steps``. The entry ``"success"`` is its
    success, and ``"is_init"`` whether it begins.

    All random numbers come from the level's ``seed`` and the number of the step: equal levels and
    actions make equal episodes.

    Args:
        levels: [*B], with an entry for each parameter, and a ``seed`` if anything is random.
        max_steps: step limit of an episode.
        device: of the states.

    Attributes:
        state_size: count S of a state's numbers.
        observation_size: count of an observation's numbers.
        actions: count of discrete actions; None for continuous ones.
        forces: count of continuous actions, each clipped to -1 to 1.
        draws: count of random numbers for a step, and for the beginning.
    """

    state_size: ClassVar[int]
    observation_size: ClassVar[int]
    actions: ClassVar[int | None] = None
    forces: ClassVar[int] = 1
    draws: ClassVar[int] = 0

    def __init__(
        self,
        levels: TensorDictBase,
        *,
        max_steps: int = 100,
        device: torch.device | str = "cpu",
    ) -> None:
        check_torch_defaults()
        batch = levels.batch_size
        super().__init__(device=device, batch_size=batch, allow_done_after_reset=True)
        self.max_steps = max_steps
        flag = Binary(1, (*batch, 1), dtype=torch.bool)
        # One entry if observations are the state, which is then neither stored nor reset twice.
        self._state = "observation" if type(self).observe is BatchedEnv.observe else "state"
        self.observation_spec = Composite(
            {
                "observation": Unbounded((*batch, self.observation_size)),
                self._state: Unbounded((*batch, self.state_size)),
                "step_count": Unbounded((*batch, 1), dtype=torch.int64),
                "success": flag,
                "is_init": flag.clone(),
            },
            shape=batch,
        ).to(self.device)
        self.action_spec = (
            Unbounded((*batch, self.forces), device=self.device)
            if self.actions is None
            else Categorical(self.actions, batch, device=self.device)
        )
        self.reward_spec = Unbounded((*batch, 1), device=self.device)
        ends = {key: flag.clone() for key in ("done", "terminated", "truncated")}
        self.done_spec = Composite(ends, shape=batch).to(self.device)
        self._next = {
            str(name): (one.float() if one.is_floating_point() else one).to(self.device, copy=True)
            for name, one in levels.items()
        }
        self._level = {name: entry.clone() for name, entry in self._next.items()}

    def begin(self, level: Values, chance: Tensor) -> Tensor:
        """Returns the first states of episodes, float [*B, S]; by default zeros.

        Args:
            level: the parameters of the levels.
            chance: uniform numbers from 0 to 1, float [*B, draws].
        """
        return torch.zeros(*self.batch_size, self.state_size, device=self.device)

    @abstractmethod
    def advance(self, state: Tensor, action: Tensor, level: Values, chance: Tensor) -> Step:
        """Returns the results of actions.

        Args:
            state: float [*B, S].
            action: int64 [*B], or float [*B, forces] from -1 to 1.
            level: the parameters of the levels.
            chance: as in :meth:`begin`, with other numbers at every step.
        """

    def observe(self, state: Tensor, level: Values) -> Tensor:
        """Returns observations, float [*B, observation_size]; by default the state."""
        return state

    @classmethod
    def features(cls, level: Values) -> Tensor:
        """Returns more features of levels for models of outcomes, float [*B, F]; here none."""
        return next(iter(level.values())).unsqueeze(-1)[..., :0]

    def set_levels(self, levels: TensorDictBase) -> None:
        """Sets levels [*B], which are played from their next resets on."""
        for name, place in self._next.items():
            place.copy_(levels[name])

    def maybe_reset(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Begins finished episodes anew, without waiting for a GPU to tell if there are any."""
        done = tensordict["done"]
        if population.at_hand(done):
            return super().maybe_reset(tensordict)
        begun = self._begun(done)
        return tensordict.copy().update(
            {key: begun[key].where(done, tensordict[key]) for key in begun.keys()}
        )

    def _reset(self, tensordict: TensorDictBase | None = None, **_: object) -> TensorDict:
        # TorchRL takes these entries only for the levels that are reset.
        return self._begun(None if tensordict is None else tensordict.get("_reset", None))

    def _begun(self, which: Tensor | None) -> TensorDict:
        """Takes the levels that were set, those of bool [*B, 1] or all, and begins all anew."""
        for name, following in self._next.items():
            level = self._level[name]
            level.copy_(following if which is None else following.where(which.squeeze(-1), level))
        none = torch.zeros(*self.batch_size, 1, dtype=torch.bool, device=self.device)
        steps = none.long()
        return self._entries(self.begin(self._level, self._chance(steps)), steps, none, none, none)

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        steps = tensordict["step_count"] + 1
        action = tensordict["action"]
        if self.actions is None:
            action = action.clamp(-1, 1)
        made = self.advance(tensordict[self._state], action, self._level, self._chance(steps))
        terminated = made.terminated.unsqueeze(-1)
        truncated = (steps >= self.max_steps) & ~terminated
        success = made.success.unsqueeze(-1) & (terminated | truncated)
        state = self._entries(made.state, steps, success, terminated, truncated)
        return state.set("reward", made.reward.unsqueeze(-1))

    def _entries(
        self, state: Tensor, steps: Tensor, success: Tensor, terminated: Tensor, truncated: Tensor
    ) -> TensorDict:
        entries = {
            "observation": self.observe(state, self._level),
            self._state: state,
            "step_count": steps,
            "success": success,
            "is_init": steps == 0,
            "terminated": terminated,
            "truncated": truncated,
            "done": terminated | truncated,
        }
        return TensorDict(entries, self.batch_size, device=self.device)

    def _chance(self, steps: Tensor) -> Tensor:
        """Returns uniform numbers for steps int64 [*B, 1]: float [*B, draws]."""
        if not self.draws:
            return steps.new_zeros(*self.batch_size, 0, dtype=torch.float32)
        return uniform(self._level[SEED].unsqueeze(-1), steps, self.draws)

    def _set_seed(self, seed: int | None) -> None:
        """Does nothing: random numbers come from the levels' seeds."""


def uniform(seed: Tensor, step: Tensor, count: int) -> Tensor:
    """Returns pseudorandom uniform numbers from 0 to 1, equal for equal seeds and steps.

    They are hashes of seed, step and their place by the finalizer of SplitMix64 (Steele et al.
    2014, "Fast Splittable Pseudorandom Number Generators", OOPSLA).

    Args:
        seed: int64 [*B, 1].
        step: int64 [*B, 1].
        count: of numbers.

    Returns:
        float32 [*B, count], below 1.

    Example:
        >>> uniform(torch.tensor([7]), torch.tensor([1]), 2)
        tensor([0.6513, 0.4378])
    """
    place = torch.arange(1, count + 1, device=seed.device)
    x = finalized(finalized(seed) + step * STEP) + place * ENTRY
    return (finalized(x) >> 40 & (1 << 24) - 1).float() * UNIT


def finalized(x: Tensor) -> Tensor:
    """Returns hashes of int64 numbers, in which every bit depends on all bits of the number."""
    for shift, factor in zip(SHIFT, (*MIX, 1), strict=True):
        x = (x ^ (x >> shift & (1 << 64 - shift) - 1)) * factor
    return x


class BatchedTask(Task):
    """A task of a :class:`~proposer_rl.tasks.batched_envs.BatchedEnv` with named parameters.

    Args:
        env: dotted name of the environment's class.
        max_steps: step limit of an episode.
        parameters: what differs between levels, by name.
        network: of the Solver.
        levels: fixed evaluation levels of each distribution.
        solver: the Solver's training.
        context: device, precision and cores.
        seeded: whether levels have seeds, from which random numbers come.

    Raises:
        ArgumentError: naming the key, if there is no such class, or a parameter is not valid.
    """

    noun = "levels"
    batched: bool | None = True
    replayed = ("rollouts",)

    def __init__(
        self,
        *,
        env: str,
        max_steps: Annotated[int, Ge(1)],
        parameters: dict[str, RangeSettings],
        network: NetworkSettings,
        levels: Annotated[int, Ge(1)],
        solver: SolverSettings,
        context: ComputeContext,
        seeded: bool = True,
    ) -> None:
        self._class, self._network = _environment_class(env), network
        self.memory = network.memory
        self.title = self._class.__name__.removesuffix("Env")
        if network.memory is not None:
            self.batched = None
        space, target = spaces(parameters, seeded=seeded, device=context.device)
        self.edit, self.target_shares = space.edit, space.shares(target)
        super().__init__(
            distributions={"target": target, "all": space},
            target="target",
            space=space,
            solver=solver,
            context=context,
            levels=levels,
            max_steps=max_steps,
            measured={
                "environment": env,
                "levels": levels,
                "steps": max_steps,
                "parameters": {name: one.measured for name, one in parameters.items()},
            },
        )

    @property
    def about(self) -> dict[str, str]:
        """Returns facts about the task for readers, by their labels."""
        return {"Target": str(self.target), **super().about}

    def environment(self, levels: TensorDictBase) -> EnvBase:
        """Returns an environment of levels [*B]."""
        return self._class(levels, max_steps=self.max_steps, device=self.device)

    def features(self, levels: Levels) -> Tensor:
        """Returns features of where levels [K, n] lie, and the environment's: float [K, n, F]."""
        return torch.cat([super().features(levels), self._own_features(levels)], -1)

    def inputs(self, levels: Levels) -> Tensor:
        """Returns the environment's own features of levels [*B], or without any where they lie."""
        own = self._own_features(levels)
        return own if own.shape[-1] else super().inputs(levels)

    def _own_features(self, levels: Levels) -> Tensor:
        level = {str(name): entry for name, entry in levels.items()}
        return self._class.features(level).double().cpu()

    def network(self) -> nn.Module:
        """Returns two MLPs, of the policy and of the critic, or a network with memory."""
        kind = self._class
        acts = Unbounded(kind.forces) if kind.actions is None else Categorical(kind.actions)
        return solver_network([Unbounded(kind.observation_size)], acts, self._network)


def _environment_class(name: str) -> type[BatchedEnv]:
    with within("env", ValueError):
        kind: Any = import_object(name)
    if not (isinstance(kind, type) and issubclass(kind, BatchedEnv)):
        raise ArgumentError(f"env={name!r}: must be a subclass of BatchedEnv")
    return kind
