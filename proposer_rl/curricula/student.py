"""The functions of a student that a curriculum may ask for.

Most curricula ask for none. The others list what they need in :attr:`Curriculum.needs`, so that any
training loop has to provide only that, and a student that lacks something is refused before a run
begins. :class:`TaskStudent` is the student of this library's own loop.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable
from functools import cached_property
from typing import Any, cast

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from proposer_rl.learning import PPO, RolloutCollector, gae
from proposer_rl.meta.first_order import Direction, LevelGradients, exact_alignment, exact_direction
from proposer_rl.settings import ArgumentError
from proposer_rl.task import DifferentiableTask, Levels, OptimalTask, Task

VALUE = "state_value"  # the critic's entry in a rollout


class UnfitStudentError(TypeError):
    """A student lacks what a curriculum needs; the message is one line that names it."""


class Student:
    """A student as a curriculum sees it, with counters of what the curriculum asked for.

    Each ability of a student is a function, given to the constructor or defined by a subclass.
    Levels are [n] for any n unless stated otherwise; results have no gradients. Using a function
    that the student lacks raises :class:`UnfitStudentError`.

    Args:
        gamma, lmbda: discount, and decay of generalised advantages, with which curricula read the
            values of a critic.
        batch_size: number P of levels that :attr:`play` takes at once; None for any number.
        can: functions by name, such as ``performance=evaluate``.

    Attributes:
        frames: environment steps that were played for the curriculum.
        evaluations: levels that were evaluated for the curriculum.

    Raises:
        ArgumentError: for an unknown name.

    Example:
        >>> student = Student(optimal_return=lambda levels: torch.ones(levels.shape))
        >>> student.lacks("optimal_return"), student.lacks("probe")
        (None, 'it has no probe(levels)')
    """

    play: Callable[[Levels, torch.Generator], TensorDictBase]
    """Plays on at most ``batch_size`` levels without training: a rollout [n, T].

    The rollout is TorchRL's, with ``state_value`` if a score reads a critic. An outcome [n] as of
    :func:`~proposer_rl.curricula.outcome_of` may take its place. Actions are drawn from the
    generator.
    """
    performance: Callable[[Levels, torch.Generator], TensorDictBase]
    """Returns ``return`` and, if the task has one, ``success`` on each level: a tensordict [n].

    These are expectations, or estimates from episodes.
    """
    exact_performance: Callable[[Levels], TensorDictBase]
    """Returns ``performance`` if it is exact, so that no generator is needed."""
    probe: Callable[[Levels], Tensor]
    """Returns the student's behaviour on probe levels [C], for a Proposer: float [C, ...]."""
    optimal_return: Callable[[Levels], Tensor]
    """Returns the highest expected return of any policy on each level, float [n]."""
    gradient_norms: Callable[[Levels], Tensor]
    """Returns the squared length of the gradient of the return on each level, float [n]."""
    policy_gradient_norms: Callable[[TensorDictBase], Tensor]
    """Returns the squared length of each level's policy gradient in a rollout [n, T], float [n]."""
    target_direction: Callable[[Levels, str], tuple[Tensor, Direction]]
    """Returns performance on levels [E] of the target, float [], and the direction that raises it.

    The second argument is the measure; see :mod:`proposer_rl.meta.first_order`.
    """
    alignment: Callable[[Direction, Levels, float], Tensor]
    """Returns the slope of the return on each level along a direction of the parameters, float [n].

    The last argument is the step of the finite differences, in learning rates.
    """
    snapshot: Callable[[], TensorDict]
    """Returns all of the student that training changes, batch []."""

    def __init__(
        self,
        *,
        gamma: float = 0.99,
        lmbda: float = 0.95,
        batch_size: int | None = None,
        **can: Callable[..., Any],
    ) -> None:
        self.gamma, self.lmbda, self.batch_size = gamma, lmbda, batch_size
        self.frames, self.evaluations = 0, 0
        for name, function in can.items():
            if name not in ABILITIES:
                raise ArgumentError(f"{name}: unknown; there are: {', '.join(ABILITIES)}")
            setattr(self, name, function)

    def spend(self, *, frames: int = 0, evaluations: int = 0) -> None:
        """Adds to the counters of frames and evaluations."""
        self.frames += frames
        self.evaluations += evaluations

    def lacks(self, name: str) -> str | None:
        """Returns why the student lacks this function; None if the student has it."""
        if name in vars(self) or hasattr(type(self), name):
            return None
        _, *given = inspect.signature(getattr(TaskStudent, f"_{name}")).parameters
        return f"it has no {name}({', '.join(given)})"

    def __getattr__(self, name: str) -> Any:
        if name in ABILITIES:
            raise UnfitStudentError(f"{name}: {self.lacks(name)}")
        raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")


ABILITIES = tuple(Student.__annotations__)
"""Names of the functions that a student can have."""


def require(student: Student, needs: Iterable[str], who: str) -> None:
    """Refuses a student that lacks a function which ``who`` needs.

    Raises:
        UnfitStudentError: naming the first that is missing, and why.
    """
    for name in needs:
        reason = student.lacks(name)
        if reason is not None:
            raise UnfitStudentError(f"{who} needs a student with {name}: {reason}")


class TaskStudent(Student):
    """A Solver that trains by PPO on a task, and can do all that the task allows.

    Args:
        task: that evaluates it.
        learner: PPO of K Solvers.
        replica: the number of this one among them.
    """

    def __init__(self, task: Task, learner: PPO, replica: int = 0) -> None:
        numbers = learner.settings
        super().__init__(
            gamma=numbers.gamma,
            lmbda=numbers.lmbda,
            batch_size=learner.env.batch_size[1:].numel(),
            **{name: getattr(self, f"_{name}") for name in ABILITIES},
        )
        self._task = task
        self._learner = learner if learner.copies == 1 else learner.replica(replica)

    def lacks(self, name: str) -> str | None:
        """Returns why the task does not allow this function; None if it does."""
        kinds: dict[str, tuple[type, str]] = {
            "optimal_return": (OptimalTask, "optimal_return(levels)"),
            **dict.fromkeys(
                ("gradient_norms", "target_direction", "alignment"),
                (DifferentiableTask, "differentiable_performance(agent, levels)"),
            ),
        }
        task = type(self._task).__name__
        if name == "exact_performance" and not self._task.exact_performance:
            return f"{task} measures performance by playing, which is not exact"
        if name in kinds and not isinstance(self._task, kinds[name][0]):
            return f"{task} must define {kinds[name][1]}"
        return None

    def _play(self, levels: Levels, generator: torch.Generator) -> TensorDictBase:
        env, collector = self._spectators
        env.set_levels(self._filled_up(levels))
        rollout = collector.collect([generator])[0]
        self.spend(frames=rollout.numel())
        return rollout[: len(levels)]

    @torch.no_grad()
    def _performance(self, levels: Levels, generator: torch.Generator) -> TensorDictBase:
        self.spend(evaluations=len(levels))
        return self._task.performance(self._learner.agent, levels.unsqueeze(0), generator)[0]

    def _exact_performance(self, levels: Levels) -> TensorDictBase:
        return self.performance(levels, torch.Generator())

    @torch.no_grad()
    def _probe(self, levels: Levels) -> Tensor:
        return self._task.probe(self._learner.agent, levels)[0]

    def _optimal_return(self, levels: Levels) -> Tensor:
        return cast(OptimalTask, self._task).optimal_return(levels)

    def _gradient_norms(self, levels: Levels) -> Tensor:
        self.spend(evaluations=len(levels))
        return self._gradients.of_returns(self._learner, levels.unsqueeze(0))[0]

    def _policy_gradient_norms(self, rollout: TensorDictBase) -> Tensor:
        rollout = rollout.unsqueeze(0)
        advantage = advantages(self, rollout).float()
        return self._gradients.of_rollouts(self._learner, rollout, advantage)[0]

    @cached_property
    def _gradients(self) -> LevelGradients:
        return LevelGradients(self._task)

    def _target_direction(self, levels: Levels, measure: str) -> tuple[Tensor, Direction]:
        self.spend(evaluations=len(levels))
        task = cast(DifferentiableTask, self._task)
        reached, direction = exact_direction(task, self._learner, levels.unsqueeze(0), measure)
        return reached[0], direction

    def _alignment(self, direction: Direction, levels: Levels, step: float) -> Tensor:
        self.spend(evaluations=2 * len(levels))
        task = cast(DifferentiableTask, self._task)
        return exact_alignment(task, self._learner, direction, levels.unsqueeze(0), step)[0]

    def _snapshot(self) -> TensorDict:
        return self._learner.snapshot()[0]

    @cached_property
    def _spectators(self) -> tuple[EnvBase, RolloutCollector]:
        return self._task.spectators(self._learner)

    def _filled_up(self, levels: Levels) -> Levels:
        """Repeats the last of levels [n] until they fill an environment [1, P].

        Returns:
            [1, P].
        """
        assert self.batch_size is not None
        count = len(levels)
        if count < self.batch_size:
            levels = levels[torch.arange(self.batch_size).clamp(max=count - 1)]
        return levels.unsqueeze(0)


def advantages(student: Student, rollout: TensorDictBase, lmbda: float | None = None) -> Tensor:
    """Computes generalised advantages A_t, not standardised: float64 [*B, n, T].

    Args:
        student: whose discount and decay of traces are used.
        rollout: with ``state_value``, [*B, n, T].
        lmbda: in place of the student's decay; 0 for the error of one step.

    Raises:
        ArgumentError: see :func:`values`.
    """
    for steps in (rollout, rollout["next"]):
        values(steps)
    estimate = gae(student.gamma, student.lmbda if lmbda is None else lmbda, VALUE)
    return estimate(rollout.copy())["advantage"].squeeze(-1).double()


def values(steps: TensorDictBase) -> Tensor:
    """Returns the critic's values of steps, float [*B, 1].

    Raises:
        ArgumentError: if the steps have no values.
    """
    if VALUE not in steps.keys():
        raise ArgumentError(
            f"rollout: has no {VALUE} at each step and in next, which this curriculum needs; let a "
            "critic write it first, as GAE does, or use a score that needs no critic"
        )
    value: Tensor = steps[VALUE]
    return value
