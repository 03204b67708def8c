"""``bin/play`` as users call it; the page itself is in ``tests/play``."""

from __future__ import annotations

import os
import re
import socket
import subprocess
import sys
import webbrowser
from pathlib import Path
from signal import SIGINT
from subprocess import PIPE, STDOUT

import httpx
import pytest
import uvicorn

from proposer_rl import extras
from proposer_rl.cli import play
from proposer_rl.extras import install_command
from tests.processes import LONGEST, ROOT

CLIENT = httpx.Client(timeout=LONGEST, trust_env=False)  # a busy machine is slow


def refusal(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    """The line with which the command is refused."""
    with pytest.raises(SystemExit) as ended:
        play.main([str(argument) for argument in arguments])
    said = capsys.readouterr()
    assert ended.value.code == 2 and said.out == ""
    return said.err.splitlines()[-1]


def test_it_tells_its_address_and_ends_on_ctrl_c(run: Path, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "proposer_rl.cli.play", run]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    with subprocess.Popen(
        command, cwd=tmp_path, env=environment, text=True, stdout=PIPE, stderr=STDOUT
    ) as served:
        try:
            assert served.stdout is not None
            line = served.stdout.readline()
            found = re.search(r"http://127\.0\.0\.1:(\d+)/([\w-]{40,})/", line)
            assert found
            assert CLIENT.get(f"{found[0]}api/run").json()["checkpoints"] == [1, 2, 3]
            assert CLIENT.get(f"http://127.0.0.1:{found[1]}/").status_code == 403
            for address in own_addresses():  # from outside of the machine there is nothing
                with pytest.raises(OSError), socket.create_connection((address, int(found[1])), 5):
                    pass
            served.send_signal(SIGINT)
            assert served.communicate(timeout=LONGEST)[0] == "Ended.\n"
        finally:
            served.kill()
    assert served.returncode == 0
    assert list(tmp_path.iterdir()) == []


def test_the_browser_is_opened_only_when_asked(
    run: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(self: uvicorn.Server, sockets: object) -> None:
        raise KeyboardInterrupt

    opened: list[str] = []
    monkeypatch.setattr(webbrowser, "open", opened.append)
    monkeypatch.setattr(uvicorn.Server, "run", interrupted)
    play.main([str(run)])
    assert opened == []
    capsys.readouterr()
    play.main([str(run), "--open"])
    assert capsys.readouterr().out == f"Open {opened[0]} in a browser on this machine; " + (
        "Ctrl-C ends it.\nEnded.\n"
    )


def own_addresses() -> set[str]:
    """Addresses of this machine that others may know."""
    try:
        found = socket.getaddrinfo(socket.gethostname(), None, socket.AF_INET)
    except socket.gaierror:
        return set()
    return {str(entry[4][0]) for entry in found if not str(entry[4][0]).startswith("127.")}


def test_a_port_in_use_is_told(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        line = refusal(capsys, run, "--port", port)
    assert line.startswith(f"error: --port {port}: Address already in use")


def test_without_its_extra_it_says_how_to_get_it(
    run: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(extras, "find_spec", lambda name: None)
    line = refusal(capsys, run)
    command = install_command("play")
    assert line == f"error: bin/play needs starlette and uvicorn; install with: {command}"
