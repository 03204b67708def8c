"""The pages of runs of seconds: mazes, mazes seen through a window, and cars."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.commands import trained_run
from tests.play.pages import CARS, VIEWS, Page, served
from tests.tiny import EXAMPLES


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
def car_page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(EXAMPLES)
        run = trained_run(tmp_path_factory.mktemp("runs") / "cars", *CARS)
        with served(run) as page:
            yield page
