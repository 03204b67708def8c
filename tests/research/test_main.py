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
