"""What a run says of itself, with a clock that goes as it is told."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from proposer_rl.runs.status import FILE, Activity, Status, duration


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now

    def pass_(self, seconds: float) -> None:
        self.now += seconds


def test_the_rest_is_what_is_left_times_what_it_took(tmp_path: Path) -> None:
    """A run of three cycles of five updates, each cycle after twelve parts of an improvement."""
    clock, left = Clock(), {"improve": 3, "update": 15}
    status = Status(parts=12, clock=clock)
    end = 3 * (12 * 7 + 5 * 2)
    with status.of_run(tmp_path, lambda: None):
        for cycle in range(3):
            status.plan(left)
            with status.phase("improve"):
                for part in range(12):
                    clock.pass_(7)
                    status.tick("training the copies", part + 1)
                    seconds, all_known = status.remaining()
                    # In the first cycle nothing is known of updates: it takes at least the rest.
                    updates = 30 if cycle == 0 else 0
                    assert seconds == pytest.approx(end - clock.now - updates)
                    assert all_known == (cycle > 0)
            for _ in range(5):
                with status.phase("update"):
                    clock.pass_(2)
            left = {"improve": left["improve"] - 1, "update": left["update"] - 5}
            assert status.remaining() == (pytest.approx(end - clock.now), True)
    assert status.remaining()[0] == 0


def test_the_file_says_what_is_going_on_and_is_gone_at_the_end(tmp_path: Path) -> None:
    clock, shown = Clock(), []
    status = Status(parts=4, clock=clock)
    status.plan({"improve": 2, "update": 1})
    status.tick("before there is a folder", 1)
    with status.of_run(tmp_path, lambda: shown.append(status.activity().text())):
        with status.phase("improve"):
            for part in range(3):
                clock.pass_(10)
                status.tick("training the copies", part + 1)
            written = Activity(**json.loads((tmp_path / FILE).read_text()))
            assert written == Activity("training the copies", 3, 4, 50.0, True)
        with status.phase("update"):  # at once: nothing is written more often than once a second
            assert json.loads((tmp_path / FILE).read_text())["done"] == 3
    assert shown == [
        "improve",
        *(f"training the copies {n}/4, at least {s} left" for n, s in ((1, "70 s"), (2, "60 s"))),
        "training the copies 3/4, at least 50 s left",
    ]
    assert not list(tmp_path.iterdir())


def test_nothing_is_said_of_a_rest_whose_largest_part_is_unknown(tmp_path: Path) -> None:
    clock = Clock()
    status = Status(clock=clock)
    status.plan({"measure": 9, "improve": 9})
    with status.of_run(tmp_path, lambda: None):
        with status.phase("measure"):
            clock.pass_(1)
        assert status.activity() == Activity("", 0, 0, 8.0, True)
        with status.phase("improve"):
            assert status.activity() == Activity("improve", 0, 0, None, True)


@pytest.mark.parametrize("stop", [KeyboardInterrupt, SystemExit, ArithmeticError])
def test_a_run_that_stops_or_breaks_does_nothing_any_more(
    stop: type[BaseException], tmp_path: Path
) -> None:
    status = Status(clock=(clock := Clock()))
    with pytest.raises(stop), status.of_run(tmp_path, lambda: None), status.phase("update"):
        assert json.loads((tmp_path / FILE).read_text())["doing"] == "update"
        raise stop
    assert not list(tmp_path.iterdir())
    clock.pass_(10)
    status.tick("cleaning up", 1)
    assert not list(tmp_path.iterdir())


def test_why_a_run_broke_is_told_though_its_folder_cannot_be_changed(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    folder.mkdir()
    with pytest.raises(ArithmeticError), Status().of_run(folder, lambda: None):
        folder.rename(tmp_path / "moved")
        folder.touch()  # what is in a file cannot be removed
        raise ArithmeticError


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0, "0 s"), (119, "119 s"), (120, "2 min"), (7199, "120 min"), (18_000, "5 h"), (2e5, "2 d")],
)
def test_durations_are_in_the_unit_that_reads_best(seconds: float, text: str) -> None:
    assert duration(seconds) == text
