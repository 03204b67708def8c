"""A real browser: the system's Chromium, which asks for nothing that a page does not."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser"))), None)
OPTIONS = [
    *("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
]
LONGEST = 300_000.0  # milliseconds: what takes longer never comes, and a run must not wait for ever
needs_chromium = pytest.mark.skipif(CHROMIUM is None, reason="there is no chromium on the PATH")


@contextmanager
def chromium() -> Iterator[Any]:
    """The browser, as Playwright drives it, with time enough for a machine that is busy."""
    from playwright.sync_api import expect, sync_playwright

    expect.set_options(timeout=LONGEST)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=CHROMIUM, args=OPTIONS, timeout=LONGEST
        )
        yield browser
        browser.close()


def new_context(browser: Any, **options: Any) -> Any:
    """A context of the browser that waits as long as the browser does."""
    context = browser.new_context(**options)
    context.set_default_timeout(LONGEST)
    return context
