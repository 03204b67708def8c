"""The page in a real browser: drawn on, played, slid, and asked by a page that is not it."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser, BrowserContext, Download, Locator, expect
from playwright.sync_api import Page as Tab

from proposer_rl.cli.stored import stored_run
from proposer_rl.models import cell_logits
from proposer_rl.tasks.mazes.drawings import SETS, read_levels
from proposer_rl.tasks.mazes.evaluation import ExactEvaluator
from proposer_rl.tasks.mazes.levels import Level, planes
from tests.browser import chromium, needs_chromium, new_context
from tests.play.pages import Page, served
from tests.tasks.mazes.oracles import path_length

pytestmark = needs_chromium


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with chromium() as browser:
        yield browser


@pytest.fixture
def context(browser: Browser) -> Iterator[BrowserContext]:
    with new_context(browser, viewport={"width": 1200, "height": 900}) as context:
        yield context


def opened(context: BrowserContext, address: str) -> Iterator[Tab]:
    """The page in a tab; it writes nothing to the console and asks nobody but its server."""
    tab = context.new_page()
    said: list[str] = []
    asked: list[str] = []
    tab.on("console", lambda message: said.append(message.text))
    tab.on("pageerror", lambda error: said.append(str(error)))
    tab.on("request", lambda request: asked.append(request.url))
    tab.goto(address)
    expect(tab.locator("#gallery button").first).to_be_visible()
    yield tab
    # A refusal is shown on the page; Chromium says it in the console, too.
    assert [line for line in said if "status of 400" not in line] == []
    assert [url for url in asked if not url.startswith((address, "data:", "blob:"))] == []


@pytest.fixture
def tab(context: BrowserContext, page: Page) -> Iterator[Tab]:
    yield from opened(context, page.address)


@pytest.fixture
def view_tab(context: BrowserContext, view_page: Page) -> Iterator[Tab]:
    yield from opened(context, view_page.address)


@pytest.fixture
def car_tab(context: BrowserContext, car_page: Page) -> Iterator[Tab]:
    yield from opened(context, car_page.address)


def place(tab: Tab, row: int, column: int, height: int = 5, width: int = 5) -> tuple[float, float]:
    """Where a cell's middle is on the screen."""
    box = tab.locator("#board").bounding_box()
    assert box is not None
    x = box["x"] + box["width"] * (column + 0.5) / width
    return x, box["y"] + box["height"] * (row + 0.5) / height


def drag(tab: Tab, *cells: tuple[int, int], button: Any = "left") -> None:
    tab.mouse.move(*place(tab, *cells[0]))
    tab.mouse.down(button=button)
    for cell in cells[1:]:
        tab.mouse.move(*place(tab, *cell))
    tab.mouse.up(button=button)


def saved(tab: Tab, folder: Path) -> list[str]:
    """The level on the page, by way of its Save button."""
    given = download(tab)
    file = folder / given.suggested_filename
    given.save_as(file)
    (level,) = read_levels(file).values()
    return str(level.to_text()).splitlines()


def download(tab: Tab) -> Download:
    """What Save gives; if nothing, whether it was not heard, refused or not downloaded."""
    with tab.expect_download() as started, tab.expect_response(re.compile("/file$")) as answer:
        tab.get_by_role("button", name="Save", exact=True).click()
    assert answer.value.ok
    return started.value


def success(
    run: Path, rows: list[str], number: int, limit: int | None = None, solver: int = 0
) -> str:
    """What the page must say, computed without it."""
    stored = stored_run(run)
    stage = stored.stage(stored.files[number])
    agent = stage.learner.agent
    level = Level.from_text("\n".join(rows))
    logits = cell_logits(agent, planes(level.expand(2, 1)))[solver, 0].detach()
    evaluator = ExactEvaluator(limit or max(10, 2 * path_length(level)))
    chance = float(evaluator(level, logits)["success"])
    digits = 1 if 0.0005 <= chance <= 0.9995 else 0
    return f"After {stage.updates} updates: {100 * chance:.{digits}f} % success"


def slide(tab: Tab, number: int) -> None:
    tab.locator("#checkpoint").focus()
    tab.keyboard.press("Home")
    for _ in range(number):
        tab.keyboard.press("ArrowRight")


def row_of(tab: Tab, name: str) -> Locator:
    return tab.locator("#results tbody tr").filter(has_text=name)


def test_what_is_drawn_is_evaluated_exactly(tab: Tab, page: Page, tmp_path: Path) -> None:
    status = tab.locator("#status")
    empty = ["S....", ".....", ".....", ".....", "....G"]
    expect(status).to_have_text(success(page.run, empty, 2))
    drag(tab, (1, 0), (1, 3))  # in one move: the cells between are drawn, too
    drag(tab, (4, 4), (2, 0))  # the goal
    drawn = ["S....", "####.", "G....", ".....", "....."]
    assert saved(tab, tmp_path) == drawn
    expect(status).to_have_text(success(page.run, drawn, 2))
    expect(row_of(tab, "Shortest path")).to_contain_text("yes10")
    drag(tab, (1, 2), (1, 2))  # a wall on a wall takes it away
    drag(tab, (1, 0), (1, 1), button="right")
    drawn[1] = "...#."
    assert saved(tab, tmp_path) == drawn
    expect(status).to_have_text(success(page.run, drawn, 2))
    tab.keyboard.press("Control+z")
    tab.get_by_role("button", name="Undo").click()
    drawn[1] = "####."
    assert saved(tab, tmp_path) == drawn
    tab.get_by_label("Step limit").fill("4")
    tab.get_by_label("Step limit").press("Enter")
    expect(status).to_have_text(success(page.run, drawn, 2, 4))


def test_a_level_is_drawn_with_keys_alone(tab: Tab, page: Page, tmp_path: Path) -> None:
    tab.locator("#board").focus()
    # The frame begins at the start. A wall; the goal beside it; the start below.
    for key in ("ArrowDown", "ArrowDown", "ArrowRight", "Space", "4", "ArrowRight", "Enter"):
        tab.keyboard.press(key)
    for key in ("3", "ArrowDown", "Space", "1", "ArrowUp", "ArrowLeft", "Space"):
        tab.keyboard.press(key)
    expect(tab.get_by_role("radio", name="free")).to_be_checked()
    drawn = [".....", "..G..", "..S..", ".....", "....."]
    assert saved(tab, tmp_path) == drawn
    expect(tab.locator("#status")).to_have_text(success(page.run, drawn, 2))
    tab.get_by_label("Rows").fill("7")
    tab.get_by_label("Rows").press("Enter")
    tab.get_by_label("Columns").fill("4")
    tab.get_by_label("Columns").press("Enter")
    resized = ["....", "..G.", "..S.", "....", "....", "....", "...."]
    assert saved(tab, tmp_path) == resized
    expect(tab.locator("#status")).to_have_text(success(page.run, resized, 2))


def test_nothing_moves_while_a_level_is_evaluated(tab: Tab) -> None:
    status = tab.locator("#status")
    expect(status).to_contain_text("success")
    button = tab.get_by_role("button", name="Save", exact=True)
    before = button.bounding_box()
    tab.route("**/examine", lambda route: None)  # holds what is asked
    drag(tab, (1, 0), (1, 3))
    expect(row_of(tab, "Shortest path")).to_contain_text("………")
    assert button.bounding_box() == before
    tab.unroute("**/examine")
    expect(row_of(tab, "Shortest path")).to_contain_text("yes8")
    assert button.bounding_box() == before


def test_the_slider_shows_every_checkpoint(tab: Tab, page: Page) -> None:
    empty = ["S....", ".....", ".....", ".....", "....G"]
    for number in (0, 1, 2):
        slide(tab, number)
        expect(tab.locator("#status")).to_have_text(success(page.run, empty, number))
        expect(tab.locator("#updates")).to_have_text(f"{number + 1} of 3 · update {2 * number + 2}")
    tab.locator("#solver").select_option(label="5")
    expect(tab.locator("#status")).to_have_text(success(page.run, empty, 2, solver=1))
    tab.get_by_role("button", name="Go through all checkpoints").click()
    expect(tab.locator("#along .unknown")).to_have_count(0)
    expect(tab.locator("#updates")).to_have_text("3 of 3 · update 6")


def test_checkpoints_that_are_gone_leave_the_slider(
    context: BrowserContext, run: Path, tmp_path: Path
) -> None:
    copy = tmp_path / "run"
    shutil.copytree(run, copy)
    with served(copy) as page:
        for tab in opened(context, page.address):
            expect(tab.locator("#updates")).to_have_text("3 of 3 · update 6")
            first = stored_run(copy).files[0]
            first.rename(tmp_path / "gone")
            slide(tab, 0)
            expect(tab.locator("#updates")).to_have_text("2 of 2 · update 6")
            expect(tab.locator("#status")).to_contain_text("After 6 updates")
        (tmp_path / "gone").rename(first)


def test_it_is_played_with_the_arrow_keys(tab: Tab) -> None:
    drag(tab, (1, 0), (1, 1))
    status = tab.locator("#status")
    expect(status).to_contain_text("success")
    tab.get_by_role("button", name="Play it yourself").click()
    expect(status).to_contain_text("Your turn")
    you = row_of(tab, "You")
    tab.keyboard.press("ArrowDown")  # into the wall: a move that leads nowhere
    expect(you).to_contain_text("…1…")
    for key in ["ArrowRight"] * 4 + ["ArrowDown"] * 4:
        tab.keyboard.press(key)
    expect(status).to_have_text("You reach the goal in 9 moves; 8 are the least.")
    expect(you).to_contain_text("yes90.91")
    expect(row_of(tab, "Shortest path")).to_contain_text("yes80.92")
    tab.keyboard.press("r")
    tab.mouse.click(*place(tab, 0, 4))  # one move towards there
    tab.mouse.click(*place(tab, 3, 2))
    expect(you).to_contain_text("…2…")
    tab.keyboard.press("r")
    for _ in range(17):
        tab.keyboard.press("ArrowLeft")
    expect(status).to_have_text("Out of steps: 16 are all there are.")
    expect(you).to_contain_text("no–−0.16")
    tab.keyboard.press("Escape")
    expect(you).to_have_count(0)


@pytest.mark.parametrize("kind", ["greedy", "sampled"])
def test_the_solver_is_watched(tab: Tab, kind: str) -> None:
    expect(tab.locator("#status")).to_contain_text("success")
    tab.locator("#episode").select_option(kind)
    tab.get_by_role("button", name="Watch the Solver").click()
    expect(tab.locator("#status")).to_contain_text("The Solver ")
    reaches = "yes" in row_of(tab, "greedy").inner_text()
    told = tab.locator("#status").inner_text()
    if kind == "greedy":
        assert ("reaches" in told) == reaches
        moves = row_of(tab, "greedy").locator("td").nth(1).inner_text()
        assert not reaches or f"in {moves} moves" in told


def test_levels_are_taken_from_the_run_a_set_and_a_file(
    tab: Tab, page: Page, tmp_path: Path
) -> None:
    tab.get_by_label("Take levels from").select_option(label="shapes")
    shapes = read_levels(SETS["shapes"])
    expect(tab.locator("#gallery button")).to_have_count(len(shapes))
    name, level = list(shapes.items())[3]
    tab.get_by_role("button", name=name, exact=True).click()
    rows = str(level.to_text()).splitlines()
    assert saved(tab, tmp_path) == rows
    expect(tab.locator("#status")).to_have_text(success(page.run, rows, 2))
    mine = tmp_path / "two.txt"
    mine.write_text("[one]\nS....\n.....\n.....\n....G\n[other]\nS....\n#####\n")
    tab.set_input_files("#file", mine)
    expect(tab.locator("#trouble")).to_contain_text("two.txt: level 'other': a level is a rec")
    mine.write_text("[one]\nS....\n.....\n.....\n....G\n")
    tab.set_input_files("#file", mine)
    tab.get_by_role("button", name="one", exact=True).click()
    assert saved(tab, tmp_path) == ["S....", ".....", ".....", "....G"]
    tab.get_by_label("Take levels from").select_option(label="update 2, seed 3")
    expect(tab.locator("#found")).to_have_text("After 2 updates")
    tab.get_by_label("Take levels from").select_option(label="id")
    first = tab.locator("#gallery img").first
    before = first.get_attribute("src")
    tab.get_by_role("button", name="New draw").click()
    expect(first).not_to_have_attribute("src", str(before))


@pytest.mark.slow
def test_cars_are_shown_in_pictures(car_tab: Tab) -> None:
    caption, updates = car_tab.locator("#caption"), car_tab.locator("#updates")
    expect(car_tab.locator("#editor")).to_be_hidden()
    expect(updates).to_have_text("2 of 2 · update 4")
    car_tab.locator("#gallery button").nth(2).click()
    expect(caption).to_contain_text("target_0_2: ")
    expect(car_tab.locator("#lines")).to_have_text(re.compile(r"gravity 1\s+power 0\.7"))
    assert car_tab.evaluate("document.getElementById('picture').naturalWidth") == 120
    slide(car_tab, 0)
    expect(updates).to_have_text("1 of 2 · update 2")
    expect(car_tab.locator("#found")).to_have_text(
        re.compile(r"After 2 updates, mean of \d+ levels: .+ success, return .+")
    )
    expect(caption).to_contain_text("target_0_2: ")
    expect(car_tab.locator("#along .unknown")).to_have_count(0)
    car_tab.get_by_label("Take levels from").select_option(label="update 4")
    expect(car_tab.locator("#found")).to_have_text("After 4 updates")
    expect(caption).to_have_text("update_4_0")
    expect(updates).to_have_text("1 of 2 · update 2")
    car_tab.get_by_label("Take levels from").select_option(label="all")
    car_tab.get_by_role("button", name="Go through all checkpoints").click()
    expect(car_tab.locator("#along .unknown")).to_have_count(0)
    expect(updates).to_have_text("2 of 2 · update 4")


def test_it_fits_a_phone_and_everything_has_a_name(
    browser: Browser, page: Page, car_page: Page
) -> None:
    nameless = """() => [...document.querySelectorAll("button, input, select, canvas")]
        .filter((one) => one.checkVisibility() && !one.labels?.length && !one.ariaLabel
            && !one.textContent.trim()).map((one) => one.outerHTML)"""
    # A list that scrolls, and pictures that are cut off or stretched.
    unfit = """() => [...document.querySelectorAll("#gallery, #gallery img")].filter((one) =>
        one.scrollHeight > one.clientHeight || one.naturalWidth && Math.abs(
            one.clientWidth / one.clientHeight - one.naturalWidth / one.naturalHeight) > 0.05
        ).map((one) => [one.id, one.scrollHeight, one.clientHeight])"""
    for address in (page.address, car_page.address):
        phone = {"viewport": {"width": 360, "height": 740}, "has_touch": True}
        with new_context(browser, **phone) as context:
            for tab in opened(context, address):
                assert tab.evaluate("document.documentElement.scrollWidth") <= 360
                assert tab.evaluate(nameless) == []
                tab.locator("#gallery img").first.wait_for()
                assert tab.evaluate(unfit) == []
                assert tab.evaluate("document.documentElement.lang") == "en"


@pytest.mark.slow
def test_a_maze_seen_through_a_window_is_drawn_watched_and_played(view_tab: Tab) -> None:
    tab, status = view_tab, view_tab.locator("#status")
    table = tab.locator("#results tbody")
    expect(table.locator("tr").first).to_contain_text("Solver, 5 episodes")
    assert tab.locator("#policy").is_hidden() and tab.locator("#colour").is_hidden()
    # The empty level: start and goal in opposite corners, and the agent looks to the right.
    tab.get_by_role("button", name="Play it yourself").click()
    for key in [*["ArrowUp"] * 4, "ArrowRight", *["ArrowUp"] * 4]:
        tab.locator("#board").press(key)
    expect(status).to_have_text("You reach the goal in 9 moves; 9 are the least.")
    tab.get_by_role("button", name="Stop playing").click()
    # Turned upwards, it has to turn first.
    tab.get_by_role("radio", name="start ^").click()
    drag(tab, (0, 0))
    drag(tab, (0, 0), (1, 0))
    tab.get_by_role("radio", name="wall").click()
    drag(tab, (2, 0), (2, 3))
    expect(status).to_contain_text("success")
    rows = download(tab).path().read_text().split()[-5:]
    assert rows == [".....", "^....", "####.", ".....", "....G"]
    expect(table.locator("tr").nth(2)).to_contain_text("9")  # two turns and seven moves
    for kind in ("greedy", "sampled"):
        tab.locator("#episode").select_option(kind)
        tab.get_by_role("button", name="Watch the Solver").click()
        expect(status).to_contain_text("The Solver")
    tab.locator("#checkpoint").fill("0")
    expect(tab.locator("#updates")).to_contain_text("1 of 2 · update 2")
