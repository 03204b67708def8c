"""The one validator: what a signature says is what may be given, and the refusal is one line."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any, Literal, Protocol

import numpy as np
import pandas as pd
import pytest
import torch
from annotated_types import Interval
from omegaconf import OmegaConf
from torch import Tensor

from proposer_rl.learning import SolverSettings
from proposer_rl.meta.assembly import ProposerSettings
from proposer_rl.settings import ArgumentError, Count, Positive, Share, arguments, checked


class Task(Protocol):
    """Something that no value can be compared with."""


@checked
def make(
    task: Task,
    every: Count = 1,
    share: Share = 0.5,
    step: Positive = 1.0,
    source: Literal["exact", "episodes"] = "exact",
    best: Annotated[int, Interval(ge=2, le=9)] | None = None,
    names: Sequence[str] = (),
    shape: tuple[int, ...] = (),
    bins: Mapping[str, list[float]] | None = None,
    goal: int | float | list[int | float] = 1,
    reward: Callable[..., Any] | None = None,
    solver: SolverSettings | None = None,
    flag: bool = False,
    weights: Tensor | None = None,
    anything: Any = None,
) -> dict[str, Any]:
    """Give back what was read."""
    return dict(locals())


WRONG = [
    ("every", 0, "every=0: input should be greater than or equal to 1"),
    ("every", True, "every=True: input should be a valid integer"),
    ("every", "3", "every='3': input should be a valid integer"),
    ("step", float("nan"), "step=nan: input should be a finite number"),
    ("names", "id", "names='id': input should be a valid array"),
    ("bins", {"a share": [1, "b"]}, "bins.a share.1='b': input should be a valid number"),
    ("goal", [1, "a"], "goal.1='a': input should be a valid integer, or a valid number"),
    ("solver", {"size": 1, "ppo": {}}, "solver.size: unknown; there are: ppo"),
    ("flag", np.int64(1), "flag=1: input should be a valid boolean"),
    ("every", np.array([1]), "every=[1]: input should be a valid integer"),
    ("names", np.array(["id", 3], dtype=object), "names.1=3: input should be a valid string"),
    ("names", pd.DataFrame({"id": [1]}), "names=id 0 1: input should be an instance of Sequence"),
    ("temperature", 1, "temperature: unknown; there are: task, every, share, step, source"),
]


@pytest.mark.parametrize(("name", "value", "line"), WRONG, ids=[line for *_, line in WRONG])
def test_what_is_not_allowed_is_refused_in_one_line_by_the_callable_and_before_it(
    name: str, value: Any, line: str
) -> None:
    with pytest.raises(ArgumentError) as by_call:
        make(object(), **{name: value})
    with pytest.raises(ArgumentError) as before:
        arguments(make, {name: value}, given=["task"])
    assert str(by_call.value).startswith(line) and "\n" not in str(by_call.value)
    assert str(before.value).startswith(line.replace("there are: task, ", "there are: "))


def test_values_come_as_the_signature_has_them() -> None:
    layer, given = torch.nn.Linear(1, 1), ["id"]
    read = make(layer, 3, 1, names=given, shape=[1, 2], solver={"batch_size": 4}, reward=abs)
    assert read["task"] is layer and read["reward"] is abs
    assert type(read["share"]) is float and read["shape"] == (1, 2)
    assert read["names"] == given and read["names"] is not given
    assert read["solver"] == SolverSettings(batch_size=4)
    assert arguments(make, {"share": 1}, given=["task"]) == {"share": 1.0}


FOREIGN = [
    ("every", np.int64(3), 3),
    ("every", np.array(3, dtype=np.uint8), 3),
    ("share", np.float32(0.1), float(np.float32(0.1))),
    ("source", np.str_("episodes"), "episodes"),
    ("names", pd.Series(["id", "level"]), ["id", "level"]),
    ("shape", torch.arange(2), (0, 1)),
    ("bins", OmegaConf.create({"a": [1, 2.5]}), {"a": [1.0, 2.5]}),
    ("bins", {"a": (np.float32(0.5), torch.tensor(1))}, {"a": [0.5, 1.0]}),
    ("goal", [np.int64(2), np.float64(2.5)], [2, 2.5]),
    ("solver", OmegaConf.create({"batch_size": 4}), SolverSettings(batch_size=4)),
    ("flag", np.bool_(True), True),
]


@pytest.mark.parametrize(("name", "value", "own"), FOREIGN, ids=[str(row) for row in FOREIGN])
def test_numbers_and_lists_of_other_libraries_are_read_as_pythons(
    name: str, value: Any, own: Any
) -> None:
    read = make(object(), **{name: value})[name]
    assert read == own and repr(read) == repr(own)


def test_what_nothing_is_said_of_is_passed_on_as_it_is() -> None:
    tensor, array, pair = torch.ones(2), np.ones(2), (1, 2)
    read = make(object(), weights=tensor, anything=array)
    assert read["weights"] is tensor and read["anything"] is array
    assert make(object(), anything=pair)["anything"] is pair


def test_a_missing_argument_is_named() -> None:
    with pytest.raises(ArgumentError, match=r"^task: missing$"):
        arguments(make, {"every": 1})
    with pytest.raises(TypeError, match="'task'"):
        make()


def test_further_arguments_are_passed_on_where_they_are_taken() -> None:
    @checked
    def passes(*parts: int, every: Count, **others: Any) -> tuple[Any, ...]:
        return parts, every, others

    assert passes(1, 2, every=3, x="y") == ((1, 2), 3, {"x": "y"})
    assert arguments(passes, {"every": 3, "x": 0}) == {"every": 3, "x": 0}
    with pytest.raises(ArgumentError, match=r"^every=0"):
        passes(every=0)


def test_a_class_is_held_to_its_constructor_and_keeps_its_signature() -> None:
    class Curriculum:
        @checked
        def __init__(self, task: Task, step: Positive) -> None:
            self.step = step

    assert Curriculum(object(), step=2).step == 2.0
    assert list(inspect.signature(Curriculum).parameters) == ["task", "step"]
    for call in (
        lambda: Curriculum(object(), 0),
        lambda: arguments(Curriculum, {"step": 0}, ["task"]),
    ):
        with pytest.raises(ArgumentError, match=r"^step=0: "):
            call()


def test_settings_are_checked_where_they_are_made() -> None:
    with pytest.raises(ArgumentError, match=r"^batch_size=0: "):
        SolverSettings(batch_size=0)
    with pytest.raises(ArgumentError, match=r"^action\.spread=-1: input should be greater than 0"):
        ProposerSettings(action={"kind": "mixture", "spread": -1})
    with pytest.raises(ArgumentError, match=r"^action=.*: input tag 'x' .* 'mixture', 'problems'"):
        ProposerSettings(action={"kind": "x"})
