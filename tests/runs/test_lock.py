"""One process at a time in a folder, or at a file; runs' processes are in test_reliability.py."""

from __future__ import annotations

import os
import platform
from pathlib import Path

import pytest

from proposer_rl.runs.folder import StorageError
from proposer_rl.runs.process import InUseError, locked


def test_a_folder_is_locked_until_the_end_and_can_be_locked_again(tmp_path: Path) -> None:
    for _ in range(2):
        with locked(tmp_path):
            with pytest.raises(InUseError) as refused, locked(tmp_path):
                raise AssertionError("locked twice")
            message = str(refused.value)
            assert message.startswith(f"{tmp_path} is in use by process {os.getpid()} on ")
            assert platform.node() in message and "\n" not in message


def test_an_error_inside_gives_the_lock_up(tmp_path: Path) -> None:
    with pytest.raises(ZeroDivisionError), locked(tmp_path):
        raise ZeroDivisionError
    with locked(tmp_path):
        pass


@pytest.mark.parametrize("content", ["", "[]", "{}", "\x00"])
def test_a_holder_that_cannot_be_read_is_another_process(content: str, tmp_path: Path) -> None:
    with locked(tmp_path):
        (tmp_path / ".holder.json").write_text(content)
        with pytest.raises(InUseError, match="in use by another process"), locked(tmp_path):
            raise AssertionError("locked twice")


def test_no_folder(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.touch()
    with pytest.raises(StorageError, match=r"cannot write .*/\.lock: "), locked(file):
        raise AssertionError("locked a file")
