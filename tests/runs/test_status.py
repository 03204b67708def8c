"""What a run says of itself, with a clock that goes as it is told."""

from __future__ import annotations

from proposer_rl.runs.process import Status


def test_what_is_going_on_is_shown_once_a_second() -> None:
    now, shown = [0.0], []
    status = Status(parts=4, clock=lambda: now[0])
    status.show = lambda: shown.append(status.doing)
    status.tell("improving")
    for part in range(6):
        now[0] += 10
        status.tell("training the copies", part)
    status.tell("at once")
    parts = [f"training the copies {n}/4" for n in (1, 2, 3, 4, 4)]
    assert shown == ["improving", "training the copies", *parts]
