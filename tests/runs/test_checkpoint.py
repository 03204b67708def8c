from __future__ import annotations

import hashlib
import io
import json
import logging
import os
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from proposer_rl.runs.checkpoint import (
    FORMAT,
    CheckpointError,
    load_checkpoint,
    load_latest,
    save_checkpoint,
)
from proposer_rl.runs.folder import StorageError


def _names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_a_state_comes_back(tmp_path: Path) -> None:
    """That a training goes on from it to the bit, ``tests/test_kill.py`` shows."""
    optimizer = torch.optim.Adam([weight := torch.nn.Parameter(torch.ones(2))])
    weight.sum().backward()
    optimizer.step()
    state = {
        "optimizer": optimizer.state_dict(),
        "rng": torch.get_rng_state(),
        "misc": [1, 0.1, True, None, "text", ("a", float("inf"))],
    }
    save_checkpoint(tmp_path, 7, state)
    number, loaded = load_latest(tmp_path) or (0, {})
    assert number == 7 and loaded["misc"] == state["misc"]
    assert torch.equal(loaded["rng"], torch.get_rng_state())
    optimizer.load_state_dict(loaded["optimizer"])
    assert str(optimizer.state_dict()) == str(state["optimizer"])


@pytest.mark.parametrize("dtype", [torch.float64, torch.bfloat16, torch.int64, torch.bool])
def test_tensors_keep_bits_dtype_and_layout(tmp_path: Path, dtype: torch.dtype) -> None:
    tensor = torch.randn(2, 3, 4, 4).to(dtype).to(memory_format=torch.channels_last)
    _, state = load_checkpoint(save_checkpoint(tmp_path, 0, {"x": tensor}))
    assert state["x"].dtype == dtype
    assert state["x"].stride() == tensor.stride()
    assert torch.equal(state["x"], tensor)


def test_a_view_does_not_drag_its_whole_memory_along(tmp_path: Path) -> None:
    stacked = torch.nn.Parameter(torch.zeros(1000, 1000))
    path = save_checkpoint(tmp_path, 0, {"one": stacked[0]})
    assert path.stat().st_size < 10_000
    assert not load_checkpoint(path)[1]["one"].requires_grad


def test_plain_torch_can_read_what_follows_the_two_lines(tmp_path: Path) -> None:
    with open(save_checkpoint(tmp_path, 5, {"x": 1.5}), "rb") as file:
        digest = file.readline().strip().decode()
        assert digest == hashlib.sha256(file.read()).hexdigest()
        file.seek(len(digest) + 1)
        assert json.loads(file.readline()) == {"format": FORMAT, "step": 5}
        assert torch.load(file, weights_only=True) == {"x": 1.5}


@pytest.mark.parametrize(
    ("state", "message"),
    [
        ({"a": [object()]}, r"state\['a'\]\[0\] is a object"),
        ({"a": {np.int64(1): 2}}, r"a key of state\['a'\] is a int64"),
    ],
)
def test_refuses_to_save_what_could_not_be_loaded(
    tmp_path: Path, state: dict[str, Any], message: str
) -> None:
    with pytest.raises(CheckpointError, match=message):
        save_checkpoint(tmp_path, 1, state)
    assert _names(tmp_path) == []


def test_keeps_the_newest(tmp_path: Path) -> None:
    folder = tmp_path / "run" / "checkpoints"
    # The last one has more digits than the name is padded to.
    for step in (1, 2, 10, 10, 1_000_000_000):
        save_checkpoint(folder, step, {"step": step}, keep=2)
    assert _names(folder) == ["step_000000010.pt", "step_1000000000.pt"]
    assert load_latest(folder) == (1_000_000_000, {"step": 1_000_000_000})


def test_nothing_to_load(tmp_path: Path) -> None:
    (tmp_path / "step_x.pt").touch()
    assert load_latest(tmp_path) is None
    assert load_latest(tmp_path / "missing") is None
    with pytest.raises(StorageError, match=r"cannot read .*none\.pt: No such file"):
        load_checkpoint(tmp_path / "none.pt")


def _damage(path: Path, bytes_left: int = -1) -> None:
    path.write_bytes(path.read_bytes()[:bytes_left])


@pytest.mark.parametrize("bytes_left", [0, 100, -1])
def test_falls_back_to_the_one_before(
    tmp_path: Path, bytes_left: int, caplog: pytest.LogCaptureFixture
) -> None:
    save_checkpoint(tmp_path, 1, {"x": 1})
    _damage(save_checkpoint(tmp_path, 2, {"x": 2}), bytes_left)
    with caplog.at_level(logging.WARNING):
        assert load_latest(tmp_path) == (1, {"x": 1})
    (said,) = caplog.messages
    assert "step_000000002.pt is damaged" in said


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_any_flipped_bit_is_found(tmp_path: Path, data: st.DataObject) -> None:
    path = save_checkpoint(tmp_path, 1, {"x": torch.arange(4.0)})
    content = bytearray(path.read_bytes())
    content[data.draw(st.integers(0, len(content) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    path.write_bytes(content)
    with pytest.raises(CheckpointError, match="is damaged"):
        load_checkpoint(path)


def test_all_damaged_is_an_error_and_not_a_fresh_start(tmp_path: Path) -> None:
    for step in (1, 2):
        _damage(save_checkpoint(tmp_path, step, {}, keep=2))
    with pytest.raises(CheckpointError, match="none of the 2 checkpoints"):
        load_latest(tmp_path)


def test_a_run_goes_on_past_a_damaged_checkpoint(tmp_path: Path) -> None:
    save_checkpoint(tmp_path, 10, {})
    _damage(save_checkpoint(tmp_path, 20, {}))
    save_checkpoint(tmp_path, 15, {"x": 1}, keep=1)
    assert _names(tmp_path) == ["step_000000015.pt"]


def _envelope(header: object, payload: bytes) -> bytes:
    body = json.dumps(header).encode() + b"\n" + payload
    return hashlib.sha256(body).hexdigest().encode() + b"\n" + body


def test_another_format_is_named(tmp_path: Path) -> None:
    save_checkpoint(tmp_path, 1, {})
    other = _envelope({"format": FORMAT + 1, "step": 2}, b"whatever")
    (tmp_path / "step_000000002.pt").write_bytes(other)
    with pytest.raises(CheckpointError, match=f"has format {FORMAT + 1}.*only format {FORMAT}:"):
        load_latest(tmp_path)


class _Malicious:
    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[object, ...]:
        return os.mkdir, (str(self.path),)


def _saved(value: object) -> bytes:
    torch.save(value, file := io.BytesIO())
    return file.getvalue()


NOW = {"format": FORMAT, "step": 2}


@pytest.mark.parametrize("header", [["format"], NOW])
def test_what_is_no_checkpoint_is_refused(tmp_path: Path, header: object) -> None:
    (path := tmp_path / "step_000000002.pt").write_bytes(_envelope(header, b""))
    with pytest.raises(CheckpointError, match="is not a checkpoint of proposer_rl"):
        load_checkpoint(path)


@pytest.mark.filterwarnings("ignore:Detected pickle protocol")
@pytest.mark.parametrize("save", [lambda bad: _saved({"x": bad}), pickle.dumps])
def test_code_in_a_checkpoint_is_not_run(tmp_path: Path, save: Callable[[object], bytes]) -> None:
    target = tmp_path / "executed"
    content = _envelope(NOW, save(_Malicious(target)))
    (tmp_path / "step_000000002.pt").write_bytes(content)
    with pytest.raises(CheckpointError, match="must hold only tensors and plain data") as caught:
        load_latest(tmp_path)
    assert "\n" not in str(caught.value) and "weights_only" not in str(caught.value)
    assert not target.exists()


def test_a_crash_before_the_rename_costs_nothing(tmp_path: Path) -> None:
    """What a full disk leaves, ``tests/test_reliability.py`` asks of the command."""
    save_checkpoint(tmp_path, 1, {"x": 1})
    child = os.fork()
    if child == 0:
        os.replace = lambda *_: os._exit(9)  # type: ignore[assignment]
        try:
            save_checkpoint(tmp_path, 2, {"x": 2})
        finally:
            os._exit(1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 9
    assert _names(tmp_path) == [".step_000000002.pt.tmp", "step_000000001.pt"]
    assert load_latest(tmp_path) == (1, {"x": 1})
    save_checkpoint(tmp_path, 3, {"x": 3})
    assert _names(tmp_path) == ["step_000000001.pt", "step_000000003.pt"]
