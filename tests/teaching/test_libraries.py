"""Curricula in verl and prime-rl, by stand-ins of what these call and give."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf
from torch.utils.data import DataLoader, Sampler

import proposer_rl as prl
from proposer_rl.settings import ArgumentError
from proposer_rl.teaching.prime_rl import TaughtTasks
from tests.teaching.test_sampler import through_torch

PAGE = (Path(__file__).parents[2] / "docs" / "how_to" / "prompts.md").read_text(encoding="utf-8")
ROWS, ANSWERS, BATCH = 11, 4, 4


class AbstractCurriculumSampler(Sampler[int]):
    """As verl declares it: made with ``data_source`` and ``data_config``, then updated."""

    def update(self, batch: Any) -> None:
        raise NotImplementedError


@pytest.fixture
def taught_sampler(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The class as verl loads it, ``pkg://MODULE`` and its name."""
    names = ["verl", "verl.experimental", "verl.experimental.dataset"]
    for name in [*names, "verl.experimental.dataset.sampler"]:
        monkeypatch.setitem(sys.modules, name, ModuleType(name))
    sampler: Any = sys.modules["verl.experimental.dataset.sampler"]
    sampler.AbstractCurriculumSampler = AbstractCurriculumSampler
    monkeypatch.delitem(sys.modules, "proposer_rl.teaching.verl", raising=False)
    return importlib.import_module("proposer_rl.teaching.verl").TaughtSampler


class Prompts:
    """verl's data set: a table, and rows of it; two sources number theirs from 0 on."""

    def __init__(self) -> None:
        extra = [{"index": row // 2, "level": row % 3} for row in range(ROWS)]
        self.dataframe = {"data_source": ["sums", "words"] * 5 + ["sums"], "extra_info": extra}

    def __len__(self) -> int:
        return ROWS

    def __getitem__(self, row: int) -> dict[str, Any]:
        return {name: column[row] for name, column in self.dataframe.items()}


def verl(make: Any, rows: Prompts | None = None, **settings: Any) -> Any:
    """Makes the sampler as verl does."""
    named = {"class_path": "pkg://proposer_rl.teaching.verl", "class_name": "TaughtSampler"}
    config: dict[str, Any] = {"train_batch_size": BATCH, "gen_batch_size": None, "seed": 3}
    config |= {"sampler": named | settings}
    sampler = make(
        data_source=rows or Prompts(),
        data_config=OmegaConf.create(config),
    )
    assert isinstance(sampler, AbstractCurriculumSampler)
    return sampler


def solved(row: dict[str, Any]) -> float:
    """The share of answers to a prompt that are right."""
    return [0.0, 0.25, 1.0][row["extra_info"]["level"]]


def answered(rows: list[dict[str, Any]], success: str | None) -> Any:
    """A batch after its rollouts: each prompt's answers apart, in another order."""
    each = [
        (row, f"uid {number}", float(answer < ANSWERS * solved(row)))
        for answer in range(ANSWERS)
        for number, row in enumerate(rows)
    ]
    known: dict[str, Any] = {
        name: np.array([row[name] for row, _, _ in each], dtype=object) for name in rows[0]
    }
    known["uid"] = np.array([uid for _, uid, _ in each], dtype=object)
    scores = torch.zeros(len(each), 5)
    scores[:, 2] = torch.tensor([right if success is None else 2 * right - 1 for *_, right in each])
    if success is not None:
        known[success] = np.array([right for *_, right in each])
    return SimpleNamespace(batch={"token_level_scores": scores}, non_tensor_batch=known)


def steps(sampler: Any, loader: Any, success: str | None = None) -> Iterator[list[Any]]:
    """verl's order: a batch is drawn, the checkpoint saved, the sampler updated."""
    for rows in loader:
        yield rows
        sampler.update(answered(rows, success))


def loaded(sampler: Any) -> Any:
    return DataLoader(Prompts(), BATCH, sampler=sampler, drop_last=True, collate_fn=list)  # type: ignore[arg-type]


@pytest.mark.parametrize("success", [None, "acc"])
def test_verl_reports_whole_groups(taught_sampler: Any, success: str | None) -> None:
    """Of all batches of two epochs, none of which is a part; means and counts by hand."""
    settings = {"method": "mopps", "features": "extra_info.level", "source": "data_source"}
    sampler = verl(taught_sampler, **settings, settings={"decay": 0.9}, success=success)
    assert sampler._teacher._made_of["decay"] == 0.9
    places = sampler._teacher.space.coordinates.flatten().tolist()
    assert places == [row % 3 - 1 for row in range(ROWS)]
    shares = []
    for _ in range(2):
        batches = [*steps(sampler, loaded(sampler), success)]
        assert len(batches) == ROWS // BATCH
        shares += [solved(row) for rows in batches for row in rows]
    log = sampler._teacher.log()
    assert (log["told"], log["out"]) == (len(shares), 0)
    found = sampler.metrics()
    assert found["success"] == pytest.approx(np.mean(shares))
    assert found["yield"] == pytest.approx(np.mean([share == 0.25 for share in shares]))
    assert {"yield/sums", "yield/words", "predicted"} <= found.keys()
    block = sampler._teacher._ledger.blocks[-1]
    assert block.results["episodes"].tolist() == [[ANSWERS] * BATCH]


def test_verl_goes_on_from_the_checkpoint_of_its_loader(taught_sampler: Any) -> None:
    """What was out when it was saved is dropped; the rest of the epoch is the rest."""
    stateful = pytest.importorskip("torchdata.stateful_dataloader").StatefulDataLoader

    def made() -> tuple[Any, Any]:
        sampler = verl(taught_sampler, method="mopps")
        return sampler, stateful(Prompts(), BATCH, sampler=sampler, drop_last=True, collate_fn=list)

    sampler, loader = made()
    assert len([*islice(steps(sampler, loader), 2)]) == 2
    state = through_torch(loader.state_dict())
    log = sampler._teacher.log()
    assert (log["told"], log["out"]) == (BATCH, BATCH)
    sampler, loader = made()
    loader.load_state_dict(state)
    assert not [*steps(sampler, loader)]  # an epoch has two whole batches
    assert sampler._teacher.log()["out"] == 0
    assert len([*steps(sampler, loader)]) == 2
    assert sampler._teacher.log()["told"] == 2 * BATCH


SAME = Prompts()
SAME.dataframe["extra_info"] = [{"index": 0}] * ROWS
FEW = Prompts()
FEW.dataframe = {name: column[:3] for name, column in FEW.dataframe.items()}
REFUSED: dict[str, tuple[dict[str, Any], str]] = {
    "a setting": ({"methods": "mopps"}, "data.sampler.methods: unknown; there are: method, "),
    "a column": ({"features": ["extra_info.size"]}, "data: has no column extra_info.size"),
    "a source": ({"source": "family"}, "data: has no column family"),
    "no way to tell": ({"rows": SAME}, "extra_info.index: must differ within a data_source"),
    "no batch": ({"rows": FEW}, "data.train_batch_size=4: is more than 3 prompts"),
    "a score": ({"success": "right"}, "data.sampler.success=right: a batch has: data_source, "),
    "no share": ({"wrong": True}, "success=-1: must be from 0 to 1"),
}


@pytest.mark.parametrize("what", REFUSED)
def test_verl_is_refused_in_one_line(taught_sampler: Any, what: str) -> None:
    given, message = REFUSED[what]
    wrong = "acc" if given.get("wrong") else None
    settings = {name: value for name, value in given.items() if name != "wrong"}
    with pytest.raises(ArgumentError, match=message):
        sampler = verl(taught_sampler, **{"method": "domain_randomization"} | settings)
        rows = next(iter(loaded(sampler)))
        sampler.update(
            answered(
                [row | {"extra_info": {**row["extra_info"], "level": 0}} for row in rows], wrong
            )
        )


def test_the_page_configures_verl(taught_sampler: Any) -> None:
    """Its class and all settings, for rows and batches that have what it names."""
    data = OmegaConf.create(PAGE.split("```yaml\n")[1].split("```")[0]).data
    assert data.sampler.class_path == f"pkg://{taught_sampler.__module__}"
    assert data.sampler.class_name == taught_sampler.__name__
    sampler = verl(taught_sampler, **data.sampler)
    assert [*steps(sampler, loaded(sampler), data.sampler.success)]
    assert {"predicted", "yield/words"} <= sampler.metrics().keys()


class Curriculum:
    """prime-rl's: it asks its sampler for the next task, and tells it of each group."""

    def __init__(self, sampler: Any) -> None:
        self.sampler = sampler

    def on_result(self, group: list[Any]) -> None:
        self.sampler.observe(group)


def episode(task: Any, *traces: tuple[float, bool, bool], ok: bool = True) -> Any:
    """Of rewards, whether there was an error, and whether the agent learns."""
    made = [
        SimpleNamespace(
            reward=reward, has_error=error, agent=SimpleNamespace(trainable=learns), num_turns=1
        )
        for reward, error, learns in traces
    ]
    return SimpleNamespace(task=task, traces=made, ok=ok)


TASKS = [SimpleNamespace(key=f"task {place}") for place in range(6)]


def prime(tasks: Any = TASKS, **more: Any) -> tuple[prl.Teacher, Curriculum]:
    teacher = prl.Teacher("mopps", prl.Items(6), block=2)
    return teacher, Curriculum(TaughtTasks(teacher, tasks, **more))


def test_prime_rl_draws_and_observes() -> None:
    """What counts of a group, by hand; groups come back in another order, or with nothing."""
    teacher, curriculum = prime(sources=["a", "b"] * 3)
    tasks = list(islice(curriculum.sampler, 4))
    assert all(task in TASKS for task in tasks)
    good = episode(tasks[1], (1.0, False, True), (0.2, False, False))
    curriculum.on_result([good, episode(tasks[1], (0.0, False, True), (1.0, True, True))])
    curriculum.on_result([episode(tasks[0], (1.0, False, True), ok=False)])
    curriculum.on_result([episode(tasks[3], (1.0, False, True))])
    log = teacher.log()
    assert (log["proposed"], log["told"], log["dropped"], log["out"]) == (4, 2, 1, 1)
    assert log["mean_success"] == 0.75
    found = curriculum.sampler.metrics()
    assert (found["success"], found["yield"]) == (0.75, 0.5)
    state = through_torch(curriculum.sampler.state_dict())
    teacher, again = prime()
    again.sampler.load_state_dict(state)
    assert teacher.log()["out"] == 0
    curriculum.on_result([episode(tasks[2])])
    rest = [[next(one.sampler).key for _ in range(6)] for one in (curriculum, again)]
    assert rest[0] == rest[1]


def test_the_page_puts_a_sampler_into_prime_rl() -> None:
    curriculum = Curriculum(None)
    source = SimpleNamespace(curricula={"math": curriculum})
    names = {"train_source": source, "teacher": prime()[0], "tasks": TASKS}
    exec(PAGE.partition("## prime-rl")[2].split("```")[1], names)
    assert next(curriculum.sampler) in TASKS


def test_prime_rl_is_refused_in_one_line() -> None:
    with pytest.raises(ArgumentError, match="tasks: are 5, the teacher has 6"):
        prime(TASKS[:5])
    with pytest.raises(ArgumentError, match="tasks: must have a key each that no other has"):
        prime([*TASKS[:5], TASKS[0]])
