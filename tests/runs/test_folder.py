from __future__ import annotations

import errno
import json
import math
import os
import struct
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from proposer_rl.runs import folder as run_folder
from proposer_rl.runs.folder import (
    RunFolder,
    read_csv,
    read_jsonl,
    read_table,
    write_atomically,
)

TEXT = st.text(st.characters(codec="utf-8", exclude_characters="\n\r"), max_size=12)
CELLS = st.one_of(st.floats(), st.integers())


@pytest.fixture
def folder(tmp_path: Path) -> RunFolder:
    return RunFolder(tmp_path / "a" / "run")


def _bits(value: object) -> object:
    """Tells apart what == does not: 1 and 1.0, 0.0 and -0.0; and equates nan with nan."""
    if isinstance(value, float):
        return "nan" if math.isnan(value) else struct.pack("<d", value)
    return type(value), value


@given(st.lists(st.tuples(CELLS, CELLS, CELLS), min_size=1, max_size=5))
def test_csv_reads_back_bit_for_bit(
    tmp_path_factory: pytest.TempPathFactory, rows: list[tuple[object, ...]]
) -> None:
    folder = RunFolder(tmp_path_factory.mktemp("run"))
    for row in rows:
        folder.append("metrics.csv", dict(zip("abc", row, strict=True)))
    read = read_csv(folder.path / "metrics.csv")
    assert [[_bits(cell) for cell in row.values()] for row in read] == [
        [_bits(cell) for cell in row] for row in rows
    ]


@given(st.lists(st.dictionaries(TEXT, st.lists(st.floats(allow_nan=False))), min_size=1))
def test_jsonl_reads_back(
    tmp_path_factory: pytest.TempPathFactory, rows: list[dict[str, list[float]]]
) -> None:
    folder = RunFolder(tmp_path_factory.mktemp("run"))
    for row in rows:
        folder.append("cycles.jsonl", row)
    assert read_jsonl(folder.path / "cycles.jsonl") == rows


def test_csv_is_what_other_programs_read(folder: RunFolder) -> None:
    folder.append("metrics.csv", {"update": 1, "success/id": np.float64(0.1)})
    folder.append("metrics.csv", {"success/id": math.nan, "update": 2})
    assert (folder.path / "metrics.csv").read_text() == "update,success/id\n1,0.1\n2,nan\n"


def test_refuses_a_row_and_leaves_the_table(folder: RunFolder) -> None:
    folder.append("metrics.csv", {"update": 1, "loss": 0.5})
    with pytest.raises(ValueError, match="a row has update; the columns are update, loss"):
        folder.append("metrics.csv", {"update": 2})
    with pytest.raises(ValueError, match="names must have no commas, quotes or line breaks"):
        folder.append("training.csv", {"a,b": 1})
    assert [path.name for path in folder.path.iterdir()] == ["metrics.csv"]
    assert read_csv(folder.path / "metrics.csv") == [{"update": 1, "loss": 0.5}]


def _filled(folder: RunFolder, rows: int) -> None:
    for i in range(rows):
        folder.append("metrics.csv", {"update": i, "loss": i / 7})
        folder.append("cycles.jsonl", {"cycle": i, "gains": [i / 3, -0.0]})


def test_a_resumed_run_looks_as_if_it_had_never_stopped(tmp_path: Path) -> None:
    straight, resumed = RunFolder(tmp_path / "straight"), RunFolder(tmp_path / "resumed")
    _filled(straight, 5)
    _filled(resumed, 3)
    lengths = resumed.lengths()
    assert lengths == {"metrics.csv": 3, "cycles.jsonl": 3}
    resumed.append("metrics.csv", {"update": 3, "loss": 9.0})
    resumed.append("training.csv", {"a": 1})
    resumed.cut_back(json.loads(json.dumps(lengths)))

    assert resumed.lengths() == lengths
    for i in (3, 4):
        resumed.append("metrics.csv", {"update": i, "loss": i / 7})
        resumed.append("cycles.jsonl", {"cycle": i, "gains": [i / 3, -0.0]})
    assert _contents(resumed) == _contents(straight)


def _contents(folder: RunFolder) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.path.iterdir()}


@given(rows=st.integers(1, 4), torn=st.integers(0, 200))
def test_after_a_crash_at_any_byte(
    tmp_path_factory: pytest.TempPathFactory, rows: int, torn: int
) -> None:
    folder = RunFolder(tmp_path_factory.mktemp("run"))
    _filled(folder, rows)
    whole = _contents(folder)
    lengths = folder.lengths()
    _filled(folder, 3)
    for name, content in _contents(folder).items():
        (folder.path / name).write_bytes(content[: len(whole[name]) + torn])
    folder.cut_back(lengths)
    assert _contents(folder) == whole


@pytest.mark.parametrize("name", ["training.csv", "levels.jsonl"])
def test_half_a_row_is_not_read(folder: RunFolder, name: str) -> None:
    folder.append(name, {"a": 1})
    with open(folder.path / name, "ab") as file:
        file.write(b"2")
    assert read_table(folder.path / name) == [{"a": 1}]
    assert folder.lengths() == {name: 1}
    folder.cut_back({name: 1})
    folder.append(name, {"a": 2})
    assert read_table(folder.path / name) == [{"a": 1}, {"a": 2}]
    (folder.path / name).write_text("upd")  # half a header
    assert read_table(folder.path / name) == [] and folder.lengths() == {name: 0}


def test_cut_back_checks_all_before_it_changes_anything(folder: RunFolder) -> None:
    _filled(folder, 3)
    before = _contents(folder)
    with pytest.raises(ValueError, match=r"cycles\.jsonl has 3 rows, fewer than the 4"):
        folder.cut_back({"metrics.csv": 1, "cycles.jsonl": 4})
    assert _contents(folder) == before


def test_cut_back_leaves_other_files_alone(folder: RunFolder) -> None:
    _filled(folder, 1)
    folder.write_json("summary.json", {"seconds": 1.5})
    (folder.path / "checkpoints").mkdir()
    own = {
        "scores.csv": "run,level,success\nx,1,0.5\n",
        "levels.txt": "S.G\n",
        "notes.jsonl": "{}\n",
    }
    for name, content in own.items():
        (folder.path / name).write_text(content)
    assert folder.lengths() == {"metrics.csv": 1, "cycles.jsonl": 1}
    folder.cut_back(folder.lengths())
    folder.cut_back({})
    assert {path.name for path in folder.path.iterdir()} == {"checkpoints", "summary.json", *own}
    assert {name: (folder.path / name).read_text() for name in own} == own


@pytest.mark.parametrize(
    ("read", "content", "message"),
    [
        (read_csv, "a,b\n1,2\n1,2,3\n", "line 3: .* longer"),
        (read_csv, "a\nx\n", "line 2: could not convert string to float: 'x'"),
        (read_jsonl, '{"a": 1}\n{"a"\n', "line 2: Expecting"),
    ],
)
def test_what_is_no_table_is_refused_by_line(
    read: Callable[[Path], object], content: str, message: str, tmp_path: Path
) -> None:
    (tmp_path / "table").write_text(content)
    with pytest.raises(ValueError, match=message):
        read(tmp_path / "table")


@pytest.mark.parametrize("number", [errno.EINVAL, errno.EACCES])
def test_a_file_system_that_cannot_sync_folders_is_warned_of_once(
    number: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Some CIFS, VirtualBox and FUSE mounts: untitaker/python-atomicwrites#27."""

    def fsync(descriptor: int) -> None:
        if Path(os.readlink(f"/proc/self/fd/{descriptor}")).is_dir():
            raise OSError(number, os.strerror(number))

    monkeypatch.setattr(run_folder.os, "fsync", fsync)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("default")
        for _ in range(2):
            write_atomically(tmp_path / "x", b"new")
    (one,) = told
    assert str(one.message).startswith("folders cannot be synced here")
    assert (tmp_path / "x").read_bytes() == b"new"


def test_write_json_replaces_by_what_json_can_hold(folder: RunFolder) -> None:
    folder.write_json("summary.json", {"a": [1, 0.1]})
    folder.write_json("summary.json", {"b": None})
    with pytest.raises(TypeError, match="not JSON serializable"):
        folder.write_json("summary.json", {"a": object()})
    assert json.loads((folder.path / "summary.json").read_text()) == {"b": None}
    assert [path.name for path in folder.path.iterdir()] == ["summary.json"]


def test_a_file_gets_its_name_once_it_is_on_the_disk_and_so_does_the_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, done = tmp_path / "x", []
    write_atomically(path, b"old")
    fsync, replace = os.fsync, os.replace

    def note_fsync(descriptor: int) -> None:
        synced = Path(os.readlink(f"/proc/self/fd/{descriptor}"))
        done.append(("fsync", synced, synced.read_bytes() if synced.is_file() else None))
        fsync(descriptor)

    def note_replace(source: Path, target: Path) -> None:
        done.append(("replace", source, target))
        replace(source, target)

    monkeypatch.setattr(run_folder.os, "fsync", note_fsync)
    monkeypatch.setattr(run_folder.os, "replace", note_replace)
    write_atomically(path, b"new")
    temporary = done[0][1]
    assert temporary.parent == tmp_path and temporary != path
    assert done == [
        ("fsync", temporary, b"new"),  # all of it, not what a buffer has let go
        ("replace", temporary, path),
        ("fsync", tmp_path, None),
    ]
    done.clear()
    write_atomically(path, b"for now", durably=False)
    assert done == [("replace", temporary, path)] and path.read_bytes() == b"for now"


def test_an_error_leaves_the_old_file_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "x"
    write_atomically(path, b"old")

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(run_folder.os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
        write_atomically(path, b"new")
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]
