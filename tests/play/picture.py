"""The picture of the page in docs/how_to/play.md: ``python -m tests.play.picture RUN FILE``."""

from __future__ import annotations

import sys
from pathlib import Path

from playwright.sync_api import expect

from tests.browser import chromium, new_context
from tests.play.pages import served


def main(run: Path, file: Path) -> None:
    """Take a level of the run, go through its checkpoints, and show all that there is to see."""
    with served(run) as page, chromium() as browser:
        wide = {"viewport": {"width": 1180, "height": 800}, "color_scheme": "light"}
        tab = new_context(browser, **wide).new_page()
        tab.goto(page.address)
        tab.locator("#gallery button").nth(1).click()
        tab.get_by_label("Shortest path").check()
        expect(tab.locator("#status")).to_contain_text("success")
        tab.locator("#heat").select_option("success from here")
        tab.get_by_role("button", name="Go through all checkpoints").click()
        expect(tab.locator("#along .unknown")).to_have_count(0)
        tab.wait_for_timeout(1000)  # the gallery's own answer
        tab.screenshot(path=file)


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
