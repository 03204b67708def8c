"""The functions that a curriculum may ask of the students that it proposes to.

Most curricula ask for nothing; others name what they need (:attr:`Curriculum.needs`), so that a
loop of any kind gives that alone, and a student that lacks something is refused before a run
begins. :class:`TaskStudent` is that of this library, which can do all that its task allows.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Sequence
from functools import cached_property
from typing import Any, cast

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from proposer_rl.learning import PPO, RolloutCollector, gae
from proposer_rl.meta.first_order import (
    Direction,
    LevelGradients,
    exact_alignment,
    exact_direction,
)
from proposer_rl.settings import ArgumentError
from proposer_rl.task import (
    DifferentiableTask,
    Levels,
    OptimalTask,
    Task,
)

VALUE = "state_value"  # the critic's entry in a rollout


class UnfitStudentError(TypeError):
    """A student lacks what a curriculum needs; the message is a line that says what."""


class Student:
    """K students as a curriculum sees them, and a meter of what it asked of them.

    What a student can do is a function: given to the constructor, or a method of a subclass. Levels
    are [K, n] for any n unless it says otherwise, or [E] where all students get the same; results
    are without gradients. Asking for a function that it lacks raises :class:`UnfitStudentError`.

    Args:
        gamma, lmbda: discount, and decay of the traces of generalised advantages, by which
            curricula read a critic.
        batch_size: levels P that :attr:`play` takes at once; None for any number.
        can: functions by their names, such as ``performance=evaluate``.

    Attributes:
        frames: environment steps that each student was played for on a curriculum's account.
        evaluations: levels on which each was evaluated for it.

    Raises:
        ValueError: for a name that is none of these functions'.

    Example:
        >>> student = Student(optimal_return=lambda levels: torch.ones(levels.shape))
        >>> student.lacks("optimal_return"), student.lacks("probe")
        (None, 'it has no probe(levels)')
    """

    play: Callable[[Levels, Sequence[torch.Generator]], TensorDictBase]
    """A rollout [K, n, T] on at most ``batch_size`` levels, on which nobody is trained.

    TorchRL's, with ``state_value`` where a score reads a critic; or only an outcome [K, n], as
    :func:`~proposer_rl.curricula.outcome_of` describes it. Actions of student k are drawn from the
    k-th generator.
    """
    performance: Callable[[Levels, torch.Generator], TensorDictBase]
    """``return`` and, where there is one, ``success`` on each level: a tensordict [K, n].

    Expectations, or estimates from episodes.
    """
    exact_performance: Callable[[Levels], TensorDictBase]
    """``performance`` where it is exact, so that nothing is drawn."""
    probe: Callable[[Levels], Tensor]
    """Each student's behaviour on probe levels [C], as a Proposer sees it: float [K, C, ...]."""
    optimal_return: Callable[[Levels], Tensor]
    """The largest expected return that any policy reaches on levels [K, n], float [K, n]."""
    gradient_norms: Callable[[Levels], Tensor]
    """Squared length of the gradient of the return on each level, float [K, n]."""
    policy_gradient_norms: Callable[[TensorDictBase], Tensor]
    """Squared length of the policy gradient of each level of a rollout [K, n, T], float [K, n]."""
    target_direction: Callable[[Levels, str], tuple[Tensor, Direction]]
    """Performance on levels [K, E] of the target, float [K], and what raises it fastest.

    The second argument is the measure; see :mod:`proposer_rl.meta.first_order`.
    """
    alignment: Callable[[Direction, Levels, float], Tensor]
    """Slope of the return on each level along a direction of the parameters, float [K, n].

    The last argument is the step of the differences, in learning rates.
    """
    snapshot: Callable[[], TensorDict]
    """All that training changes of the students, batch [K]."""
    restore: Callable[[TensorDictBase], None]
    """Puts back what a snapshot [K] holds."""

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
        """Counts frames and evaluations that were spent on each student's account."""
        self.frames += frames
        self.evaluations += evaluations

    def lacks(self, name: str) -> str | None:
        """Returns why the student lacks the function of that name; None if it has it."""
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
    """Students of a task that train by PPO, which can do all that the task allows.

    Args:
        task: that evaluates them.
        learner: of K of them.
    """

    def __init__(self, task: Task, learner: PPO) -> None:
        numbers = learner.settings
        super().__init__(
            gamma=numbers.gamma,
            lmbda=numbers.lmbda,
            batch_size=learner.env.batch_size[1:].numel(),
            **{name: getattr(self, f"_{name}") for name in ABILITIES},
        )
        self._task, self._learner = task, learner

    def lacks(self, name: str) -> str | None:
        """Returns why the task does not allow the function of that name; None if it does."""
        kinds: dict[str, tuple[type, str]] = {
            "optimal_return": (OptimalTask, "optimal_return(levels)"),
            **dict.fromkeys(
                ("gradient_norms", "target_direction", "alignment"),
                (DifferentiableTask, "differentiable_performance(agent, levels)"),
            ),
        }
        task = type(self._task).__name__
        if name == "exact_performance" and not self._task.exact_performance:
            return f"{task} tells performance by playing, which is not exact"
        if name in kinds and not isinstance(self._task, kinds[name][0]):
            return f"{task} must define {kinds[name][1]}"
        return None

    def _play(self, levels: Levels, generators: Sequence[torch.Generator]) -> TensorDictBase:
        count = levels.shape[1]
        env, collector = self._spectators
        env.set_levels(self._filled_up(levels))
        rollout = collector.collect(list(generators))
        self.spend(frames=rollout[0].numel())
        return rollout if count == rollout.shape[1] else rollout[:, :count]

    @torch.no_grad()
    def _performance(self, levels: Levels, generator: torch.Generator) -> TensorDictBase:
        self.spend(evaluations=levels.shape[-1])
        return self._task.performance(self._learner.agent, levels, generator)

    def _exact_performance(self, levels: Levels) -> TensorDictBase:
        return self.performance(levels, torch.Generator())

    @torch.no_grad()
    def _probe(self, levels: Levels) -> Tensor:
        return self._task.probe(self._learner.agent, levels)

    def _optimal_return(self, levels: Levels) -> Tensor:
        return cast(OptimalTask, self._task).optimal_return(levels)

    def _gradient_norms(self, levels: Levels) -> Tensor:
        self.spend(evaluations=levels.shape[-1])
        return self._gradients.of_returns(self._learner, levels)

    def _policy_gradient_norms(self, rollout: TensorDictBase) -> Tensor:
        advantage = advantages(self, rollout).float()
        return self._gradients.of_rollouts(self._learner, rollout, advantage)

    @cached_property
    def _gradients(self) -> LevelGradients:
        return LevelGradients(self._task)

    def _target_direction(self, levels: Levels, measure: str) -> tuple[Tensor, Direction]:
        self.spend(evaluations=levels.shape[-1])
        return exact_direction(cast(DifferentiableTask, self._task), self._learner, levels, measure)

    def _alignment(self, direction: Direction, levels: Levels, step: float) -> Tensor:
        self.spend(evaluations=2 * levels.shape[-1])
        return exact_alignment(
            cast(DifferentiableTask, self._task), self._learner, direction, levels, step
        )

    def train(self, levels: Levels, generators: Sequence[torch.Generator]) -> None:
        """Trains on levels [K, n], with an update for each ``batch_size`` of them.

        Raises:
            DivergedError: if a number is not finite.
        """
        for some in levels.split(self._learner.env.batch_size[1:].numel(), 1):
            self._learner.env.set_levels(self._filled_up(some).to(self._task.device))
            self._learner.update(list(generators))
            self._learner.check()

    def _snapshot(self) -> TensorDict:
        return self._learner.snapshot()

    def _restore(self, snapshot: TensorDictBase) -> None:
        self._learner.restore(snapshot)

    @cached_property
    def _spectators(self) -> tuple[EnvBase, RolloutCollector]:
        return self._task.spectators(self._learner)

    def _filled_up(self, levels: Levels) -> Levels:
        """Repeats the last of levels [K, n], so that there are as many as the environment takes."""
        size, count = self._learner.env.batch_size[1:].numel(), levels.shape[1]
        if count == size:
            return levels
        if count > size:
            raise ValueError(f"{count} levels at once; the students' environment takes {size}")
        return levels[:, torch.arange(size).clamp(max=count - 1)]


def advantages(student: Student, rollout: TensorDictBase, lmbda: float | None = None) -> Tensor:
    """Returns generalised advantages A_t, not standardised: float64 [K, n, T].

    Args:
        student: whose discount and decay of traces are used.
        rollout: with ``state_value``, [K, n, T].
        lmbda: in place of the student's decay; 0 for the error of one step.

    Raises:
        ArgumentError: see :func:`values`.
    """
    for steps in (rollout, rollout["next"]):
        values(steps)
    estimate = gae(student.gamma, student.lmbda if lmbda is None else lmbda, VALUE)
    return estimate(rollout.copy())["advantage"].squeeze(-1).double()


def values(steps: TensorDictBase) -> Tensor:
    """Returns what a critic has written of steps, float [*B, 1].

    Raises:
        ArgumentError: if it has not.
    """
    if VALUE not in steps.keys():
        raise ArgumentError(
            f"rollout: has no {VALUE} in every step and next, which this curriculum reads; have a "
            "critic write it first, as GAE does, or choose a score that needs none"
        )
    value: Tensor = steps[VALUE]
    return value
