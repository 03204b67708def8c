"""Runs of seconds: mazes, mazes seen through a window, and cars; and the page of each."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.commands import trained_run
from tests.play.pages import CARS, MAZES, VIEWS, Page, served
from tests.tiny import EXAMPLES


@pytest.fixture(scope="session")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Mazes, two Solvers side by side, three checkpoints."""
    return trained_run(tmp_path_factory.mktemp("runs") / "mazes", *MAZES, "seeds=[3,5]")


@pytest.fixture(scope="session")
def car_run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(EXAMPLES)
        yield trained_run(tmp_path_factory.mktemp("runs") / "cars", *CARS)


@pytest.fixture(scope="session")
def view_page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    """Mazes seen through a window, two checkpoints."""
    with served(trained_run(tmp_path_factory.mktemp("runs") / "views", *VIEWS)) as page:
        yield page


@pytest.fixture(scope="session")
def page(run: Path) -> Iterator[Page]:
    with served(run) as page:
        yield page


@pytest.fixture(scope="session")
def car_page(car_run: Path) -> Iterator[Page]:
    with served(car_run) as page:
        yield page
