"""Numbers and lists of other libraries in spaces and results, and what becomes of features."""

from __future__ import annotations

import json
import re
import warnings
from collections.abc import Callable
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from hypothesis import given
from hypothesis import settings as profile
from hypothesis import strategies as st
from omegaconf import OmegaConf
from scipy.stats import rankdata
from sklearn.decomposition import PCA
from tensordict import TensorDict

import proposer_rl as prl
from proposer_rl.curricula.belief import WIDEST
from proposer_rl.settings import ArgumentError
from proposer_rl.tasks.ranges import RangeSettings, spaces
from proposer_rl.teaching.tables import few_columns, ranks
from tests.teaching.counting import Counting, rollout

NAN, INF, HUGE = float("nan"), float("inf"), 1e39  # finite in float64, not in float32
LINE = prl.Parameters({"s": (0.0, 1.0)}, bins=2)

# A list of Python's numbers or texts, as other libraries and files have it.
KINDS: dict[str, Callable[[list[Any]], Any]] = {
    "array": np.array,
    "NumPy's scalars": lambda values: list(np.array(values)),
    "tensor": torch.tensor,
    "tensors": lambda values: [*map(torch.tensor, values)],
    "series": pd.Series,
    "omegaconf": OmegaConf.create,
    "json": lambda values: json.loads(json.dumps(values)),
}
NUMBERS = st.lists(st.integers(-9, 9) | st.floats(-9, 9, width=32), min_size=3, max_size=5)


def levels(space: Any) -> Any:
    return space.rows(space.sample(5, torch.Generator().manual_seed(0)))


@profile(max_examples=15)
@given(st.data())
def test_choices_may_be_in_any_list(data: st.DataObject) -> None:
    """Against Python's own list: the same choices, target and draws, with the same types."""
    values: list[Any] = sorted({float(number): number for number in data.draw(NUMBERS)}.values())
    if not all(isinstance(value, int) for value in values):
        values = [*map(float, values)]
    if len(values) < 3:
        return
    own = prl.Parameters({"g": values}, target={"g": values[1]})
    for as_kind in KINDS.values():
        space = prl.Parameters({"g": as_kind(values)}, target={"g": as_kind(values)[1]})
        assert repr(space.axes) == repr(own.axes)
        assert space.target_shares.tolist() == own.target_shares.tolist()
        assert repr(levels(space)) == repr(levels(own))


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind not in ("tensor", "tensors")])
def test_texts_may_be_in_any_list(kind: str) -> None:
    texts = KINDS[kind](["flat", "stairs"])
    space = prl.Parameters({"h": texts}, target={"h": texts[1]}, named={"both": {"h": texts}})
    assert {type(level["h"]) for level in levels(space)} == {str}
    assert space.target_shares.tolist() == [0, 1]
    assert space.distributions["both"].size == 2  # type: ignore[attr-defined]


def test_choices_that_are_arrays_or_lists_stay_what_they_are() -> None:
    lists = prl.Parameters({"size": [[1, 2], [3, 4]]}, target={"size": [[3, 4]]})
    assert lists.target_shares.tolist() == [0, 1]
    mazes = [np.eye(2), np.ones((2, 2))]
    assert all(
        any(level["maze"] is m for m in mazes) for level in levels(prl.Parameters({"maze": mazes}))
    )


def test_ranges_and_counts_may_be_of_any_library() -> None:
    own = prl.Parameters({"a": (0.5, 3.0), "b": range(3, 9)}, bins={"b": 2}, target={"a": 2.0})
    given = {"a": (np.float32(0.5), torch.tensor(3)), "b": range(np.int64(3), np.int64(9))}
    space = prl.Parameters(given, bins={"b": np.int64(2)}, target={"a": np.float64(2)})
    assert levels(space) == levels(own)
    assert prl.Parameters(OmegaConf.create({"g": [1, 2, 3]}), bins=np.uint8(2)).axes == {
        "g": [1, 2, 3]
    }
    teacher = prl.Teacher(
        prl.curricula.plr(capacity=np.int64(30), temperature=np.float32(0.5)),
        space,
        seed=np.int64(1),
        block=torch.tensor(7),
    )
    assert teacher.ask(np.int64(4))[1].batch_size == (4,)


NORMAL = {"distribution": "norm", "loc": 8.0, "scale": 2.0}
WEIGHED = {"values": [3, 8.5], "weights": [1, 2]}
LINES = {"low": 0.0, "high": 10.0, "bins": 4}, {"values": [1, 2, 4]}
FILES: list[tuple[dict[str, Any], Any]] = [  # a parameter in a task's file, its target in Python
    ({**LINES[0], "target": 7.0}, 7.0),
    ({**LINES[0], "target": [2.0, 5.0]}, (2.0, 5.0)),
    ({**LINES[0], "target": NORMAL}, NORMAL),
    ({**LINES[0], "target": WEIGHED}, {**WEIGHED, "values": np.array([3, 8.5])}),
    ({**LINES[1], "target": [1, 4]}, np.array([1, 4])),
    ({**LINES[1], "target": {**WEIGHED, "values": [1, 4]}}, {**WEIGHED, "values": (1, 4)}),
]


@pytest.mark.parametrize(("file", "target"), FILES, ids=[str(file["target"]) for file, _ in FILES])
def test_a_file_and_python_describe_one_parameter_in_one_way(file: Any, target: Any) -> None:
    line = file["values"] if "values" in file else (file["low"], file["high"])
    own = prl.Parameters({"g": line}, bins=4, target={"g": target})
    read = prl.Parameters(json.loads(json.dumps({"g": file})))
    assert read.description == own.description
    task, aim = spaces({"g": RangeSettings(**file)}, seeded=False)
    assert task.axes == own.axes == read.axes
    assert task.shares(aim).tolist() == own.target_shares.tolist() == read.target_shares.tolist()
    drawn = [
        one.sample(9, torch.Generator().manual_seed(0))["g"].tolist()
        for one in (aim, own.target, read.target)
    ]
    assert drawn[0] == drawn[1] == drawn[2]


def test_texts_have_targets_as_numbers_have() -> None:
    file = {"values": ["flat", "stairs", "gap"], "target": ["gap", "flat"]}
    space = prl.Parameters(
        {"h": file}, named={"odd": {"h": {"values": ["gap", "flat"], "weights": [3, 1]}}}
    )
    assert space.target_shares.tolist() == [0.5, 0, 0.5]
    assert space.shares(space.distributions["odd"]).tolist() == [0.25, 0, 0.75]
    assert prl.Parameters({"h": file}, target={"h": "stairs"}).target_shares.tolist() == [0, 1, 0]
    assert space.description["odd"]["h"][-1] == "gap (weight 3) or flat (weight 1)"


def test_laws_that_differ_a_little_are_told_apart() -> None:
    """States are compared by their spaces' descriptions."""
    laws = [{**NORMAL, "loc": 8.0000001}, {**NORMAL, "scale": 2.0000001}, NORMAL]
    laws += [{"values": [1.0, 2.0000001], "weights": [1, w]} for w in (1, 1.0000001)]
    targets = [prl.Parameters({"g": (0.0, 9.0)}, target={"g": law}).description for law in laws]
    assert len({json.dumps(target) for target in targets}) == len(laws)


TARGETS = [np.array([1, 2]), torch.tensor([1, 2]), range(1, 3), pd.Series([1, 2]), {1, 2}, (1, 2)]


@pytest.mark.parametrize("target", TARGETS, ids=lambda target: type(target).__name__)
def test_places_of_items_may_be_in_any_list(target: Any) -> None:
    assert prl.Items(np.int64(3), target=target).target_shares.tolist() == [0, 0.5, 0.5]
    assert prl.Items(3, target=np.int64(2)).target_shares.tolist() == [0, 0, 1]
    assert prl.Items(3, target=[1, 2, 2, 2]).target_shares.tolist() == [0, 0.25, 0.75]


COLORS = pd.get_dummies(pd.Series(["red", "blue", "red"]))  # a table of truth values
FEATURES = [
    (COLORS, [[-1, 1], [1, -1], [-1, 1]]),
    (COLORS.to_numpy(), [[-1, 1], [1, -1], [-1, 1]]),
    (np.array([[-128], [0], [127]], np.int8), [[-1], [1 / 255], [1]]),  # their width is no int8
    (np.broadcast_to([3.0, 1.0], (3, 2))[:, ::-1], [[-1, -1]] * 3),
    ([[0.0], [0.5], [1.0]], [[-1], [0], [1]]),
    (OmegaConf.create([[0.0], [0.5], [1.0]]), [[-1], [0], [1]]),
    (pd.Series(["red", "blue", "red"]), [[-1, 1], [1, -1], [-1, 1]]),
    ({"a": [None, "red", "red"]}, [[1, -1], [-1, 1], [-1, 1]]),  # what is missing is a category
    ({"a": torch.tensor([0.0, 0.5, 1.0]).bfloat16().requires_grad_()}, [[-1], [0], [1]]),
]


@pytest.mark.parametrize(("features", "expected"), FEATURES)
def test_features_may_be_a_table_or_an_array(features: Any, expected: Any) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        coordinates = prl.Items(3, features=features).coordinates
    torch.testing.assert_close(coordinates, torch.tensor(expected, dtype=torch.float32))


def test_choices_that_look_alike_are_counted_one_by_one() -> None:
    teacher = prl.Teacher("plr", prl.Parameters({"on": [True, "True"]}))
    teacher.ask(40)
    counts = teacher.log()["drawn"]["on"]
    assert list(counts) == ["0: True", "1: True"] and sum(counts.values()) == 40


def test_pass_rates_may_be_a_tensor_that_numpy_does_not_take_or_not_be_known() -> None:
    rates = torch.tensor([0.0, 0.5]).bfloat16().requires_grad_()
    assert prl.Items(2, pass_rates=rates).pass_rates.tolist() == [0, 0.5]
    for unknown in (np.ma.array([0.5, 0.9], mask=[0, 1]), [0.5, None], pd.Series([0.5, None])):
        known = prl.Items(2, pass_rates=unknown).pass_rates
        assert known[0] == 0.5 and known[1].isnan()


def far_target() -> None:
    prl.Parameters({"g": (0.0, 1.0)}, target={"g": {"distribution": "norm", "loc": 5.0}})


def told(recipe: Any, *successes: Any) -> Callable[[], None]:
    def tell() -> None:
        teacher = prl.Teacher(recipe, LINE)
        for success in successes:
            teacher.tell(teacher.ask()[0], 0.0, success)

    return tell


def unsuccessful_rollouts() -> None:
    teacher = prl.Teacher("adaptive_mixture", LINE)
    for _ in range(2):
        level = teacher.ask(2)[0].view(2, 1, 1).expand(2, 3, 1)
        teacher.observe(rollout(torch.ones(2, 3), level_id=level))


@pytest.mark.parametrize(
    ("misread", "message"),
    [
        (far_target, "target.g: most of norm.* lies outside of 0 to 1"),
        (told("plr", None, True, None, True), "success: told of some levels only"),
        (told("adaptive_mixture", None, True, None), "success: missing: this curriculum learns"),
        (unsuccessful_rollouts, "success: missing: this curriculum learns"),
    ],
)
def test_what_may_be_misread_is_said_once(misread: Callable[[], None], message: str) -> None:
    with pytest.warns(UserWarning, match=message) as said:
        misread()
        told("adaptive_mixture", 0, 1)()  # of success that is told, or not used, nothing is said
        told("plr", None, None)()
    assert len(said) == 1


def doubles(n: int, generator: torch.Generator) -> torch.Tensor:
    return torch.rand(n, 3, generator=generator, dtype=torch.float64)


REAL = {
    "parameters": lambda: LINE,
    "a logarithmic scale": lambda: prl.Parameters({"s": prl.Log(0.01, 1.0)}),
    "drawn": lambda: prl.LevelGenerator(doubles, target=doubles),
    "drawn by name": lambda: prl.LevelGenerator(lambda n, g: TensorDict({"s": doubles(n, g)}, [n])),
    "made": lambda: prl.MadeLevels({"s": (0.0, 1.0)}, lambda values, g: doubles(len(values), g)),
    "a task": lambda: SimpleNamespace(space=prl.Parameters({"s": (0.0, 1.0)})),
}


@pytest.mark.parametrize("space", REAL)
def test_a_network_takes_the_levels_of_every_space(space: str) -> None:
    """Whoever asks gets torch's default dtype; a parameter by itself is a number of Python's."""
    teacher = prl.Teacher("domain_randomization", REAL[space]())
    for levels in (teacher.propose(4), teacher.ask(4)[1], teacher.ask()[1]):
        entries = [levels] if isinstance(levels, torch.Tensor) else [*levels.values()]
        for entry in entries:
            assert type(entry) is float or entry.dtype is torch.float32


def test_an_array_that_a_function_draws_is_a_tensor() -> None:
    def draw(n: int, generator: torch.Generator) -> Any:
        return np.arange(3.0 * n).reshape(n, 3)[::-1]

    space = prl.LevelGenerator(draw, target=draw, edit=lambda levels, count, g: levels.numpy() + 1)
    _, drawn = prl.Teacher("target", space).ask(4)
    assert drawn.tolist() == draw(32, torch.Generator())[:4].tolist()
    batch = space.sample(4, torch.Generator())[None]
    assert (space.edit(batch, 1, [torch.Generator()])["level"] == batch["level"] + 1).all()


LOW = {"low": 0, "high": 9}
NINE, TEXTS = {"g": range(9)}, {"g": ["a", "b"]}
P, D, PLR = prl.Parameters, prl.Items, partial(prl.Teacher, "plr")
WRONG: list[tuple[Any, Any, dict[str, Any], str]] = [
    (P, {"g": ["a", "b", "a"]}, {}, "ranges.g=.*: values=.*: must have each once"),
    (P, {"g": (0.0, HUGE)}, {}, r"ranges.g=\(0.0, 1e\+39\): .* both finite, at"),
    (P, {"g": (0, 10**400)}, {}, r"ranges.g=\(0, 10{70}.*too large"),
    (P, {"g": {**LOW, "target": [5, 11]}}, {}, r"target.g=\(5, 11\): must lie within 0 to 9"),
    (P, TEXTS, {"target": {"g": ["a", "a"]}}, r"target.g=.*\['a', 'b'\], each once"),
    (P, NINE, {"target": {"g": 2.5}}, "target.g=2.5: must be whole, as the range is"),
    (P, NINE, {"target": {"h": 1}}, "target.h: unknown; there are: g"),
    (P, NINE, {"bins": {"g": np.float64(2)}}, "bins.g=2.0: must be a wh"),
    (D, np.bool_(True), {}, "count=True: must be a whole number, at least 1"),
    (D, 4, {"target": np.array([True, False])}, r"target=\[True, False\]: must be whole numbers"),
    (D, 4, {"named": {"easy": [0, 4]}}, r"easy=\[0, 4\]: must be whole numbers from 0 to 3"),
    (D, 2, {"features": np.array([[HUGE], [0]])}, "features=1e[+]39: must be finite"),
    (D, 2, {"features": {"a": ["x", "y"], "b": [1, {}]}}, "features.b=.*: must be numbers of"),
    (D, 300, {"features": [*map(str, range(300))]}, "features.0: has 300 different texts, .* 256"),
    (D, 2, {"features": np.ma.array([[0], [9]], mask=[[0], [1]])}, "features=nan: "),
    (D, 2, {"pass_rates": [0.5, 1.5]}, "pass_rates=1.5: must be from 0 to 1"),
    (D, 2, {"pass_rates": [0.5]}, r"pass_rates: has shape \[1\], but must have \[2\]"),
    (prl.Teacher, "prl", {"space": LINE}, "curriculum='prl': must be .* one of accel"),
    (prl.Teacher, prl.tasks.maze(), {"space": LINE}, "curriculum=Recipe.*: must be prl"),
]  # fmt: skip


@pytest.mark.parametrize(("make", "value", "more", "message"), WRONG)
def test_what_is_wrong_is_refused_in_one_line(
    make: Any, value: Any, more: dict[str, Any], message: str
) -> None:
    with pytest.raises(ArgumentError, match=rf"^{message}") as refused:
        make(value, **more)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("drawn", [pd.DataFrame({"a": [1]}), np.ones((2, 2)), [[1.0], [2.0]]])
def test_as_many_levels_are_drawn_as_were_asked_for(drawn: Any) -> None:
    with pytest.raises((RuntimeError, TypeError)):
        prl.Teacher("plr", prl.LevelGenerator(lambda n, g: drawn)).ask()


@pytest.mark.parametrize("name", ["plr", "learning_progress"])
def test_the_largest_results_harm_no_curriculum(name: str) -> None:
    """Differences of returns that float32 can keep may be more than it can."""
    episodes = {} if name == "plr" else {"source": "episodes"}
    recipe = getattr(prl.curricula, name)(**episodes, **({"capacity": 8} if name == "plr" else {}))
    teacher = prl.Teacher(recipe, LINE, seed=1, block=8)
    for number in range(60):
        ticket, _ = teacher.ask()
        teacher.tell(ticket, 3.4e38 * (-1) ** number, success=number % 2)
    assert teacher.log()


@given(st.floats())
def test_results_are_those_that_float32_can_keep(number: float) -> None:
    """One ticket and several alike, against NumPy's conversion."""
    with np.errstate(over="ignore"):
        kept = bool(np.isfinite(np.float32(number)))
    for told in (number, [number]):
        teacher = prl.Teacher(Counting(), prl.Items(9), block=1)
        ticket, _ = teacher.ask()
        try:
            teacher.tell(ticket if told is number else [ticket], told)
            assert kept
        except ArgumentError as error:
            assert re.match(r"return_=\S+: must be finite in float32", str(error))
            assert not kept or abs(number) > np.finfo(np.float32).max


@profile(max_examples=50)
@given(st.lists(st.floats(-1e12, 1e12), min_size=1, max_size=9))
def test_ranks_are_those_of_scipy(column: list[float]) -> None:
    found = ranks(torch.tensor(column, dtype=torch.float64).unsqueeze(1))[:, 0]
    expected = (2 * rankdata(column) - 1) / len(column) - 1
    assert found.tolist() == pytest.approx(expected.tolist(), abs=1e-6)


@pytest.mark.parametrize("last", [None, 0.8, float("nan")])
def test_wide_features_leave_room_for_pass_rates(last: float | None) -> None:
    generator = torch.Generator().manual_seed(0)
    embedding = torch.randn(40, 60, generator=generator) * torch.linspace(0.1, 9, 60)
    rates = None if last is None else [0.2] * 39 + [last]
    items = prl.Items(40, features=embedding, pass_rates=rates)
    known = items.inputs(items.generate(torch.arange(40), []))
    assert known.shape == (40, WIDEST)  # a belief would project more, the rates among them
    columns = {None: 0, 0.8: 1}.get(last, 2)  # the second says where there is no rate
    torch.testing.assert_close(known[:, : WIDEST - columns], few_columns(embedding, columns))
    for column in known[:, WIDEST - columns :].mT[-1:]:
        assert column.tolist() == pytest.approx([-1 / 40] * 39 + [39 / 40])


def test_wide_features_are_ranks_of_their_principal_components() -> None:
    table = torch.randn(50, 30, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    table = table @ torch.randn(30, 30, generator=torch.Generator().manual_seed(2)).double()
    own = ((table - table.mean(0)) / table.std(0)).clamp(-3, 3).numpy()
    # They are not centred once more after outliers were cut off.
    expected = PCA(WIDEST).fit_transform(own - own.mean(0))
    found = few_columns(table)
    for place in range(4):  # those that are far apart in variance; signs are free
        twin = torch.from_numpy(rankdata(expected[:, place])).float()
        alike = torch.corrcoef(torch.stack([found[:, place], twin]))[0, 1].abs()
        assert float(alike) > 0.98
