"""Styles and renders figures: a colour for each method, and the same bytes every time."""

from __future__ import annotations

import io
import zlib
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure, FigureBase
from matplotlib.lines import Line2D
from PIL import Image

from proposer_rl.runs.records import Column

# Okabe and Ito's colours, which stay distinct under the common forms of colour blindness.
BLACK, ORANGE, SKY, GREEN = "#000000", "#E69F00", "#56B4E9", "#009E73"
BLUE, VERMILLION = "#0072B2", "#D55E00"
METHODS = {
    "perf_gain": VERMILLION,
    "task_difficulty": BLUE,
    "target": BLACK,
    "domain_randomization": GREEN,
    "hand_designed": ORANGE,
}
# For every other method or variant: Paul Tol's muted scheme without near doubles, with marks.
FURTHER = ("#332288", "#882255", "#44AA99", "#AA4499", "#999933", "#88CCEE", "#CC6677")
MARKS = ("o", "s", "^", "D", "v", "P", "X")
# Dashes of matplotlib, and the same as lengths of dashes and gaps for SVG and Plotly.
DASHES = {"-": "none", "--": "7,4", "-.": "7,3,2,3", ":": "2,3"}
TURN = 3  # marks further for the next method of a colour
MARKED = 9  # marks on a line
PANEL = (4.6, 3.3)  # inches
DPI = 130  # of a figure's PNG
COLOURS = 256  # of a picture in few colours

SETTINGS: Any = {
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.alpha": 0.3,
    "grid.linewidth": 0.6,
    "legend.frameon": False,
    "legend.fontsize": 8,
    "lines.linewidth": 1.8,
    "text.parse_math": False,  # a dollar sign in a name begins no formula
    "svg.hashsalt": "proposer_rl",
    "savefig.dpi": DPI,
    "figure.facecolor": "white",
    "savefig.facecolor": "white",
}


class Look(NamedTuple):
    """Colour, line and mark of a method; the mark is empty where the colour is enough."""

    colour: str
    dash: str = "-"
    mark: str = ""


class Drawing(NamedTuple):
    """A figure of the report.

    Attributes:
        name: of its files.
        title: above it.
        caption: below it.
        panels: each draws a part, at least one.
        columns: how many of them stand side by side.
        legend: looks of the methods by their labels; empty where none is needed.
        size: width and height of a panel in inches.
    """

    name: str
    title: str
    caption: str
    panels: Sequence[Callable[[FigureBase], None]]
    columns: int = 2
    legend: Mapping[str, Look] = {}
    size: tuple[float, float] = PANEL


def looks(labels: Iterable[str]) -> dict[str, Look]:
    """Returns a distinct look for each method or variant, by its label."""
    found, used = {}, Counter[int]()
    for label in sorted(set(labels)):
        if label in METHODS:
            found[label] = Look(METHODS[label])
            continue
        first = zlib.crc32(label.encode())
        order = [(first + i) % len(FURTHER) for i in range(len(FURTHER))]
        place = min(order, key=used.__getitem__)
        again = used[place]
        mark = MARKS[(place + TURN * again) % len(MARKS)]
        found[label] = Look(FURTHER[place], [*DASHES][again % len(DASHES)], mark)
        used[place] += 1
    return found


def style(look: Look, points: int = 2) -> dict[str, Any]:
    """Returns matplotlib's arguments for a line in this style with some number of points."""
    alone = "." if points == 1 else ""
    every = max(1, -(-points // MARKED))
    return {
        "color": look.colour,
        "linestyle": look.dash,
        "marker": look.mark or alone,
        "markersize": 4,
        "markevery": every,
    }


def finish(
    axes: Axes, x: str, y: str, means: Sequence[Column], *, rate: bool = False, zero: bool = False
) -> None:
    """Names the axes and fits the ordinate to the means, as intervals of few runs can be huge."""
    axes.set(xlabel=x, ylabel=y)
    axes.margins(x=0.01)
    values = np.concatenate([[], *means])
    values = values[np.isfinite(values)]
    if rate or not len(values):
        axes.set_ylim(0, 1)
        return
    low, high = float(values.min()), float(values.max())
    zero = zero and low >= 0
    margin = 0.3 * (high - (0 if zero else low)) or 0.1 * abs(high) or 1.0
    axes.set_ylim(0 if zero else low - margin, high + margin)


def render(drawing: Drawing, *suffixes: str) -> list[bytes]:
    """Renders a figure as ``svg`` or ``png`` from one layout, which takes most of the time."""
    with rc_context(SETTINGS):
        figure = _laid_out(drawing)
        return [_render(figure, suffix) for suffix in suffixes]


def in_few_colours(png: bytes) -> bytes:
    """Returns a PNG in few colours and a third of its size."""
    file = io.BytesIO()
    # Other algorithms merge the colours of two methods.
    far, plain = Image.Quantize.MAXCOVERAGE, Image.Dither.NONE
    with Image.open(io.BytesIO(png)) as image:
        few = image.convert("RGB").quantize(COLOURS, far, dither=plain)
    few.save(file, format="PNG", optimize=True)
    return file.getvalue()


def _laid_out(drawing: Drawing) -> Figure:
    columns = min(drawing.columns, len(drawing.panels))
    rows = -(-len(drawing.panels) // columns)
    width, height = drawing.size
    legend = 0.3 * -(-len(drawing.legend) // max(2 * columns, 1))
    size = (width * columns, height * rows + legend)
    figure = Figure(figsize=size, dpi=DPI, layout="constrained")
    grid = figure.subfigures(rows, columns, squeeze=False)
    for draw, part in zip(drawing.panels, grid.flat, strict=False):
        draw(part)
    if drawing.legend:
        handles = [Line2D([], [], label=n, **style(one)) for n, one in drawing.legend.items()]
        figure.legend(
            handles=handles, loc="outside lower center", ncols=2 * columns, handlelength=3
        )
    layout = figure.get_layout_engine()
    assert layout is not None
    layout.execute(figure)
    figure.set_layout_engine(None)  # with one, every file would be drawn twice
    return figure


def _render(figure: Figure, suffix: str) -> bytes:
    file = io.BytesIO()
    # Without a date the same runs give the same file.
    metadata = {"Date": None} if suffix == "svg" else {"Software": None}
    figure.savefig(file, format=suffix, metadata=metadata)
    return file.getvalue()
