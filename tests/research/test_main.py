"""``bin/research``: its names."""

from __future__ import annotations

import pytest

from research.__main__ import NAMES, main


def test_every_name_starts_its_module(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in NAMES:
        monkeypatch.setattr("sys.argv", ["research", name, "--help"])
        with pytest.raises(SystemExit) as end:
            main()
        assert end.value.code == 0 and f"usage: bin/research {name}" in capsys.readouterr().out


def test_without_a_name_all_are_listed_and_a_wrong_one_is_refused(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["research"])
    main()
    assert all(about in capsys.readouterr().out for about in list(NAMES.values())[:1])
    monkeypatch.setattr("sys.argv", ["research", "magic"])
    with pytest.raises(SystemExit) as end:
        main()
    assert end.value.code == 2
    assert capsys.readouterr().err == f"error: magic: must be one of {', '.join(NAMES)}\n"
