"""What a run says of itself, with a clock that goes as it is told."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from proposer_rl.runs.process import PROGRESS, Status


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


def test_the_file_says_what_is_going_on_and_is_gone_at_the_end(tmp_path: Path) -> None:
    clock, shown = Clock(), []
    status = Status(parts=4, clock=clock)
    status.tell("before there is a folder", 1)
    with status.of_run(tmp_path, lambda: shown.append(status.doing)):
        status.tell("improving")
        for part in range(6):
            clock.now += 10
            status.tell("training the copies", part)
        status.tell("at once")  # nothing is written more often than once a second
        assert json.loads((tmp_path / PROGRESS).read_text()) == {"doing": "training the copies 4/4"}
    assert shown == [
        "improving",
        "training the copies",
        *(f"training the copies {n}/4" for n in (1, 2, 3, 4, 4)),
    ]
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("stop", [KeyboardInterrupt, SystemExit, ArithmeticError])
def test_a_run_that_stops_or_breaks_does_nothing_any_more(
    stop: type[BaseException], tmp_path: Path
) -> None:
    status = Status(clock=(clock := Clock()))
    with pytest.raises(stop), status.of_run(tmp_path, lambda: None):
        status.tell("update")
        assert json.loads((tmp_path / PROGRESS).read_text())["doing"] == "update"
        raise stop
    assert not list(tmp_path.iterdir())
    clock.now += 10
    status.tell("cleaning up", 1)
    assert not list(tmp_path.iterdir())


def test_why_a_run_broke_is_told_though_its_folder_cannot_be_changed(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    folder.mkdir()
    with pytest.raises(ArithmeticError), Status().of_run(folder, lambda: None):
        folder.rename(tmp_path / "moved")
        folder.touch()  # what is in a file cannot be removed
        raise ArithmeticError
