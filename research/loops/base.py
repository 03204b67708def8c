"""What the loops share: their description, batches of simulated environments, and one measure."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Composite, TensorSpec, Unbounded
from torchrl.envs import EnvBase, TransformedEnv

import proposer_rl as prl

EPISODES = 256  # on the target, at each evaluation
ENDS = ("done", "terminated", "truncated", "success")


@dataclass(frozen=True)
class Loop:
    """A training loop with its task.

    Attributes:
        half: of the arena: ``"develop"``, on which curricula may be tuned, or ``"report"``.
        ranges: of the levels' parameters.
        target: the level that is to be mastered, a value of some of the parameters.
        train: trains an agent on the levels of a teacher, with a seed, for a number of iterations,
            and yields it after each of them.
        success: how often an agent succeeds on the target, on the same episodes at each call.
        iterations: of a run.
        every: number of iterations between two evaluations.
        block: number of levels that the teacher proposes at once; None for its default.
    """

    half: str
    ranges: Mapping[str, Any]
    target: Mapping[str, float]
    train: Callable[[prl.Teacher, int, int], Iterator[Any]]
    success: Callable[[Any], float]
    iterations: int
    every: int
    block: int | None = None

    def run(self, curriculum: Any, seed: int, iterations: int) -> list[float]:
        """Trains an agent; returns its success on the target along training."""
        space = prl.Parameters(self.ranges, target=self.target)
        teacher = prl.Teacher(curriculum, space, seed=seed, block=self.block)
        torch.manual_seed(seed)
        found = []
        for number, agent in enumerate(self.train(teacher, seed, iterations), 1):
            if number % self.every == 0 or number == iterations:
                found.append(self.success(agent))
        return found


class SimulatedEnv(EnvBase):
    """A batch of simulated environments of one kind in TorchRL; nothing here is proposer_rl's.

    Attributes:
        level: the parameters, float [*B] each, of episodes that begin from now on.
    """

    ranges: ClassVar[Mapping[str, tuple[float, float]]]  # of the parameters
    steps: int  # after which an episode is truncated
    state_size: int
    observation_size: int

    def __init__(self, count: int, action: TensorSpec, seed: int) -> None:
        super().__init__(batch_size=[count])
        self.level = dict.fromkeys(self.ranges, torch.ones(count))
        self.draw = torch.Generator().manual_seed(seed)
        ends = {name: Binary(1, (count, 1), dtype=torch.bool) for name in ENDS}
        seen = {"observation": Unbounded((count, self.observation_size))}
        seen["success"] = ends.pop("success")
        self.observation_spec = Composite(seen, shape=[count])
        self.action_spec = action
        self.reward_spec = Unbounded((count, 1))
        self.full_done_spec = Composite(ends, shape=[count])
        self._state = torch.zeros(count, self.state_size)
        self._now = torch.zeros(count, 1)

    @abstractmethod
    def begin(self) -> Tensor:
        """Returns initial states [*B, S]."""

    @abstractmethod
    def advance(self, state: Tensor, action: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Returns the states [*B, S] after a step, its reward, and success and end, [*B] each.

        An episode that has not ended after :attr:`steps` is truncated. Success is read from the
        last step of an episode.
        """

    @abstractmethod
    def observe(self, state: Tensor) -> Tensor:
        """Returns what is seen of states, [*B, observation_size]."""

    def _set_seed(self, seed: int | None) -> None:
        self.draw.manual_seed(seed or 0)

    def _reset(self, tensordict: TensorDictBase | None = None, **_: Any) -> TensorDict:
        which = None if tensordict is None else tensordict.get("_reset", None)
        if which is None:
            which = torch.ones(*self.batch_size, 1, dtype=torch.bool)
        self._state = self.begin().where(which, self._state)
        self._now = self._now.masked_fill(which, 0)
        ends = {name: torch.zeros_like(which) for name in ENDS}
        return TensorDict({"observation": self.observe(self._state), **ends}, self.batch_size)

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        self._state, *results = self.advance(self._state, tensordict["action"])
        reward, success, over = (result.unsqueeze(-1) for result in results)
        self._now = self._now + 1
        late = self._now >= self.steps
        ends = {"success": success, "terminated": over, "truncated": late & ~over}
        entries = {"observation": self.observe(self._state), "reward": reward, **ends}
        return TensorDict({**entries, "done": over | late}, self.batch_size)


def taught(env: SimulatedEnv, teacher: prl.Teacher) -> TransformedEnv:
    """Lets a teacher choose the levels of environments."""

    def set_level(env: SimulatedEnv, levels: TensorDictBase) -> None:
        env.level = {name: levels[name].float() for name in env.ranges}

    return TransformedEnv(env, prl.LevelTransform(teacher, set_level))


@torch.no_grad()
def success_rate(env: SimulatedEnv, target: Mapping[str, float], agent: Any) -> float:
    """Returns in how many environments an agent succeeds on a level, in their first episode."""
    count = env.batch_size[0]
    env.level = {name: torch.full((count,), number) for name, number in target.items()}
    with torch.random.fork_rng():
        torch.manual_seed(0)
        after = env.rollout(env.steps, agent, break_when_any_done=False)["next"]
    first = after["done"].squeeze(-1).int().argmax(1)
    return float(after["success"].squeeze(-1)[torch.arange(count), first].float().mean())
