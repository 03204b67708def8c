"""The page in a real browser: it says nothing on the console, asks for nothing, and answers."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from proposer_rl.report import build
from proposer_rl.report.build import write_report
from proposer_rl.report.figures import learning_curves
from tests.browser import chromium, needs_chromium, new_context
from tests.report.folders import LEVEL, PIXELS, cycle, png, write_jsonl, write_run

# Where a point of a chart lies on the screen.
PIXEL = """([place, x, y]) => {
    const chart = document.querySelector(place), { left, top } = chart.getBoundingClientRect();
    const { xaxis, yaxis } = chart._fullLayout;
    return [left + xaxis._offset + xaxis.l2p(x), top + yaxis._offset + yaxis.l2p(y)];
}"""
HOSTILE = "</script><img src=x onerror=alert(1)><a href='http://example.org'>%{x}$\\bad{"
SEEDS = 6

pytest.importorskip("playwright.sync_api")
pytestmark = needs_chromium


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    runs = tmp_path_factory.mktemp("runs")
    other = {"picture": png(255 - PIXELS)}
    for seed in range(SEEDS):
        maps = [[[6, 0, 0], [0, 0, 0]], [[0, 0, 0], [0, 3, 3]]]
        cycles = [cycle(i, [0.1], maps[i], every=20) for i in range(2)]
        curve = [0.0, 0.3, 0.6, 0.8 + seed / 100]
        folder = write_run(runs / f"p{seed}", "perf_gain", [seed], curve, cycles=cycles, copies=600)
        lines = [
            {"updates": 10 * i, "seed": seed, "levels": [LEVEL if i < 3 else other]}
            for i in (1, 2, 3)
        ]
        write_jsonl(folder / "curriculum.jsonl", lines)
        for number, method in enumerate((HOSTILE, "target")):
            curve = [0.0, 0.1, 0.2, 0.1 * number + 0.3 + (3 + 5 * number) * seed / 400]
            reached = [0.1 * number, 0.5, 0.9 - 0.2 * number + seed / 100]
            write_run(runs / f"{number}{seed}", method, [seed], curve, levels=reached)
    return runs


@pytest.fixture(scope="module")
def written(runs: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(build, "DRAWINGS", [learning_curves])
        return write_report([runs], tmp_path_factory.mktemp("out") / "report")


class Seen:
    """A page, and what its browser said and asked for."""

    def __init__(self, page: Any) -> None:
        self.page = page
        self.said: list[str] = []
        self.asked: list[str] = []
        page.on("console", lambda message: self.said.append(message.text))
        page.on("pageerror", lambda error: self.said.append(str(error)))
        page.on("dialog", lambda dialog: self.said.append(dialog.message))
        page.on("request", lambda request: self.asked.append(request.url))

    def traces(self, chart: str, kind: str) -> list[dict[str, Any]]:
        """What a chart has drawn of a kind: numbers as the library holds them."""
        return self.page.evaluate(
            "([chart, kind]) => document.querySelector(chart).data.filter((t) => t.meta === kind)"
            ".map(({ x, y, z, name }) => ({ x: [...x], y: [...y], z, name }))",
            [chart, kind],
        )

    def tick(self, place: str, box: str) -> None:
        self.page.locator(f"{place} label", has_text=box).locator("input").click()

    def column(self, table: int, number: int) -> list[str]:
        rows = self.page.locator("table").nth(table).locator("tbody tr:visible")
        return rows.locator(f"td:nth-child({number})").all_inner_texts()


@pytest.fixture(scope="module")
def seen(written: Path) -> Iterator[Seen]:
    with chromium() as browser:
        seen = Seen(new_context(browser).new_page())
        seen.page.goto(written.as_uri())
        seen.page.wait_for_selector("html[data-ready]")
        yield seen


def verdicts(page: Any) -> dict[str, str]:
    rows = page.locator(".against tbody tr").all()
    return {
        row.locator("label").inner_text(): row.locator("td").nth(3).inner_text() for row in rows
    }


@pytest.mark.usefixtures("undrawn")
def test_what_is_ticked_is_compared_alone_and_in_colour(
    seen: Seen, runs: Path, tmp_path: Path
) -> None:
    """As ``--compare`` compares it."""
    whole, answer = verdicts(seen.page), seen.page.locator(".answer").inner_text()
    assert list(whole) == ["perf_gain", "target", f"{HOSTILE} (baseline)"]
    assert [*whole.values()][2] == "–" and whole["perf_gain"] == "better, p < 0.001"
    coloured = {trace["name"] for trace in seen.traces(".curves", "median")}
    assert len(coloured) == 2 and "perf_gain" in coloured  # the first, and the baseline
    assert [trace["name"] for trace in seen.traces(".curves", "rest")] == ["target"]
    assert {trace["name"] for trace in seen.traces(".curves", "band")} == coloured
    seen.tick(".against", "target")
    assert [trace["name"] for trace in seen.traces(".curves", "rest")] == ["perf_gain"]
    planned = write_report([runs], tmp_path, compare=["target", HOSTILE])
    page = seen.page.context.new_page()
    page.goto(planned.as_uri())
    page.wait_for_selector("html[data-ready]")
    assert verdicts(page) == verdicts(seen.page)
    assert verdicts(page)["perf_gain"] == "–" and verdicts(page)["target"] != "–"
    said = page.locator(".answer p").first.inner_text()
    assert seen.page.locator(".answer").inner_text() == said and said != answer
    page.close()
    seen.tick(".against", "target")
    assert verdicts(seen.page) == whole and seen.page.locator(".answer").inner_text() == answer


def test_the_answer_fits_the_first_screen(seen: Seen) -> None:
    box, view = seen.page.locator(".against").bounding_box(), seen.page.viewport_size
    assert box["x"] + box["width"] <= view["width"] and box["y"] + box["height"] <= view["height"]


def test_single_seeds_are_switched_on_and_off(seen: Seen) -> None:
    assert not seen.traces(".curves", "seed")
    seen.tick(".seeds", "4")
    rows = {trace["name"]: trace["y"] for trace in seen.traces(".curves", "seed")}
    assert rows["perf_gain"] == [0, 0.3, 0.6, 0.84] and len(rows) == 2
    seen.tick(".seeds", "4")
    assert not seen.traces(".curves", "seed")


def test_the_axis_and_the_measure_are_chosen(seen: Seen) -> None:
    def of_perf_gain() -> dict[str, Any]:
        return {trace["name"]: trace for trace in seen.traces(".curves", "median")}["perf_gain"]

    button = seen.page.locator(".axes button", has_text="frames")
    button.click()
    assert button.get_attribute("aria-pressed") == "true"
    # 30 updates of 100 own frames and 600 of copies.
    assert of_perf_gain()["x"][-1] == pytest.approx(0.021)
    seen.page.locator(".axes button", has_text="updates").click()
    assert of_perf_gain()["x"] == [0, 10, 20, 30]
    seen.page.select_option(".measure", label="fuel")
    assert of_perf_gain()["y"] == [-1, -2, -3]
    assert seen.page.locator(".axes button", has_text="frames").is_disabled()
    seen.page.select_option(".measure", label="ID success rate")


def test_values_are_told_where_the_pointer_is(seen: Seen) -> None:
    seen.page.locator(".curves").scroll_into_view_if_needed()
    left, top = seen.page.evaluate(PIXEL, [".curves", 30, 0.825])
    for steps in range(3):
        seen.page.mouse.move(left - 5 + steps, top)
    seen.page.wait_for_selector(".curves .hoverlayer .hovertext")
    text = seen.page.locator(".curves .hoverlayer").text_content()
    assert "perf_gain" in text and "0.825 [0.8, 0.85]" in text


def test_the_gains_of_the_copies_are_told(seen: Seen) -> None:
    seen.page.select_option(".measure", label="log success gain max")
    means = {trace["name"]: trace["y"] for trace in seen.traces(".curves", "median")}
    assert means == {"perf_gain": [0.2, 0.2]}
    seen.page.select_option(".measure", label="ID success rate")


def test_the_slider_moves_map_levels_and_success_together(seen: Seen) -> None:
    def shown() -> tuple[Any, ...]:
        page = seen.page
        grid = page.evaluate("document.querySelector('.map').data[0].z")
        (now,) = seen.traces(".success", "now")
        return grid, page.locator(".levels img").first.get_attribute("src"), now["x"] + now["y"]

    assert "perf_gain" in seen.page.locator(".staged option:checked").inner_text()
    slider = seen.page.locator(".moment-slider")
    before = shown()
    assert before[2] == [10, 0.3] and before[0][0] == [1, 0, 0]
    slider.focus()
    slider.press("End")
    after = shown()
    assert after[2] == [30, 0.8] and after[0][1] == [0, 0.5, 0.5]
    assert before[1] != after[1]
    assert "update 30: 0.8" in slider.get_attribute("aria-valuetext")
    seen.page.select_option(".staged", label="target, seed 0")
    assert seen.page.locator(".no-map").is_visible() and seen.page.locator(".map").is_hidden()


def test_tables_are_sorted_and_filtered(seen: Seen) -> None:
    for table, number in ((0, 6), (1, 5)):  # frames, and the mean along training
        head = seen.page.locator("table").nth(table).locator("th").nth(number - 1)
        for direction, turn in (("ascending", 1), ("descending", -1)):
            head.locator("button").click()
            assert head.get_attribute("aria-sort") == direction
            values = [float(text.split()[0]) for text in seen.column(table, number)]
            assert len(values) == 3 and values == sorted(values)[::turn]
    pairs = seen.page.locator("table").count() - 1
    seen.page.locator("details", has=seen.page.locator("table")).last.locator("summary").click()
    field = seen.page.locator("input[type=search]").last
    every = list(zip(seen.column(pairs, 2), seen.column(pairs, 3), strict=True))
    field.fill("PERF_GAIN target")
    assert seen.column(pairs, 1) and set(
        zip(seen.column(pairs, 2), seen.column(pairs, 3), strict=True)
    ) == {("perf_gain", "target")}
    field.fill("")
    assert len(seen.column(pairs, 1)) == len(every) > 6


def test_what_a_run_calls_itself_stays_text(seen: Seen) -> None:
    page = seen.page
    assert not page.locator("img[src=x]").count() and not page.locator("a[href^=http]").count()
    assert not page.evaluate("document.querySelectorAll('svg a').length")
    assert HOSTILE in page.locator(".outcomes .ytick").all_text_contents()


def test_it_needs_no_network_and_nothing_goes_wrong(seen: Seen, written: Path) -> None:
    assert [url for url in seen.asked if not url.startswith(("data:", "blob:"))] == [
        written.as_uri()
    ]
    assert not seen.said


def test_without_scripts_a_reader_is_told_where_the_figures_are(seen: Seen, written: Path) -> None:
    note = "The charts need a browser"
    assert seen.page.get_by_text(note).is_hidden() and seen.page.locator(".curves").is_visible()
    seen.page.emulate_media(media="print")
    assert seen.page.locator(".curves").is_visible() and seen.page.locator(".measure").is_hidden()
    seen.page.emulate_media(media="screen")
    still = new_context(seen.page.context.browser, java_script_enabled=False).new_page()
    still.goto(written.as_uri())
    assert still.get_by_text(note).is_visible() and still.locator(".curves").is_hidden()
