"""``bin/play`` and ``proposer-play``: draw levels in a browser, and see what a run's Solvers do."""

from __future__ import annotations

import argparse
import secrets
import webbrowser
from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from proposer_rl.cli.errors import ConfigError, command, number, settings_file
from proposer_rl.extras import require_package

if TYPE_CHECKING:
    from proposer_rl.play.session import Session

EPILOG = """\
examples:
  bin/play my_run                  prints the page's address
  bin/play my_run --open           opens it, too
  bin/play my_run --port 8123      a port that stays, for a tunnel or a bookmark

The page is for a browser on this machine alone; docs/how_to/play.md says how to reach it from
another."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs the command until Ctrl-C; other exit codes are those of ``cli/errors.py``."""
    command(partial(_run, _parser().parse_args(arguments)))


def _run(options: argparse.Namespace) -> None:
    require_package("bin/play", "play", "starlette", "uvicorn")
    session = open_session(options.run)
    from proposer_rl.play.server import application, listen, server

    token = secrets.token_urlsafe()
    try:
        listening = listen(options.port)
    except OSError as error:
        raise ConfigError(f"--port {options.port}: {error.strerror}") from error
    with listening, suppress(KeyboardInterrupt):
        address = f"http://127.0.0.1:{listening.getsockname()[1]}/{token}/"
        print(f"Open {address} in a browser on this machine; Ctrl-C ends it.", flush=True)
        if options.open:
            webbrowser.open(address)
        server(application(session, token)).run(sockets=[listening])
    print("Ended.")


def open_session(folder: Path) -> Session:
    """Returns the session that shows the run in a folder."""
    settings_file(folder)  # before slow imports
    from proposer_rl.cli.build import stored_run
    from proposer_rl.cli.run import run_name
    from proposer_rl.play.session import Session

    stored = stored_run(folder)
    return Session(
        folder=folder,
        title=run_name(stored.config),
        task=stored.task,
        seeds=stored.config.seeds,
        load=lambda file: stored.stage(file)[1:],
    )


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="bin/play",
        description="Open a run on a local page: draw levels, or take some of the run, and see "
        "what the Solver of any checkpoint does there; play them yourself.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("run", metavar="RUN", type=Path, help="a run's folder")
    parser.add_argument(
        "--port",
        type=number(int, 0, 2**16 - 1),
        default=0,
        help="on which the page is served (default: a free one)",
    )
    parser.add_argument("--open", action="store_true", help="open the page in the browser")
    return parser


if __name__ == "__main__":
    main()
