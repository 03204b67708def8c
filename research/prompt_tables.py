"""What a study of curricula of prompts shows: measures of its runs, a page and a picture."""

from __future__ import annotations

import io
import json
import lzma
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import FigureBase
from numpy.typing import NDArray

from proposer_rl.report.publish import MARK
from proposer_rl.report.statistics import Interval, difference_of, holm, mean_of, median_interval
from proposer_rl.report.style import Drawing, finish, in_few_colours, looks, render, style
from proposer_rl.runs.folder import write_atomically
from research.tiny_lm import CELLS, FAMILIES, LEVELS

Array = NDArray[np.float64]
EASY = 2  # levels of each family, whose losses count as forgetting
BUDGET = 0.8  # of dynamic sampling's rollouts: ours may have 1.25 times as many
HALF = 0.5
FEWER_ERRORS = 0.9
CURVES = "passed.csv.xz"
FACTS = "runs.csv"


def tables_of(results: Sequence[Mapping[str, Any]]) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Returns runs as two tables: a row for each, and one for each evaluation of each."""
    facts, curves = [], []
    for run in results:
        own = {"arm": run["arm"], "seed": run["seed"]}
        errors = {f"error of {name}": value for name, value in run.get("errors", {}).items()}
        noise = {"noise": run["noise"]} if "noise" in run else {}
        numbers = {name: run[name] for name in ("flat", "seconds", "curriculum_seconds")}
        drawn = {f"drawn {name}": value for name, value in zip(cells(), run["drawn"], strict=True)}
        facts.append({**own, **numbers, **noise, **errors, **drawn})
        for rollouts, rates in zip(run["rollouts"], run["passed"], strict=True):
            curves.append({**own, "rollouts": rollouts, **dict(zip(cells(), rates, strict=True))})
    return pd.DataFrame(facts), pd.DataFrame(curves)


def cells() -> list[str]:
    """Returns the columns of levels of families."""
    return [f"{family} {level}" for family, level in CELLS]


class Study:
    """pd.DataFrame of some arms with the same seeds.

    Attributes:
        curves: pass rates of each arm, float [S, E, families, levels].
        rollouts: at each of E evaluations, [E].
    """

    def __init__(self, facts: pd.DataFrame, curves: pd.DataFrame) -> None:
        self.facts = {name: own.sort_values("seed") for name, own in facts.groupby("arm")}
        self.rollouts = np.sort(curves["rollouts"].unique()).astype(float)
        self.curves: dict[str, Array] = {}
        for name, own in curves.sort_values(["seed", "rollouts"]).groupby("arm"):
            rates = own[cells()].to_numpy()
            shape = -1, len(self.rollouts), len(FAMILIES), LEVELS
            self.curves[str(name)] = rates.reshape(shape)
        self.arms = [name for name in facts["arm"].drop_duplicates() if name in self.curves]

    def rate(self, arm: str, family: str | None = None) -> Array:
        """Returns the pass rate of an arm, of all families or one, [S, E]."""
        of = slice(None) if family is None else [FAMILIES.index(family)]
        found: Array = self.curves[arm][:, :, of].mean((2, 3))
        return found

    def at(self, arm: str, share: float) -> Array:
        """Returns the pass rate at a share of all rollouts, [S]."""
        place = share * self.rollouts[-1]
        return np.array([np.interp(place, self.rollouts, one) for one in self.rate(arm)])

    def reaching(self, arm: str, of: str, family: str | None = None) -> Array:
        """Returns the share of all rollouts until another arm's final pass rate, 1 at most, [S]."""
        goals = self.rate(of, family)[:, -1]
        pairs = zip(self.rate(arm, family), goals, strict=True)
        return np.array([first_reached(self.rollouts, one, goal) for one, goal in pairs])

    def forgotten(self, arm: str) -> Array:
        """Returns how far the easy levels are from their best at the end, on average, [S]."""
        easy = self.curves[arm][..., :EASY].mean(-1)
        found: Array = (easy.max(1) - easy[:, -1]).mean(-1)
        return found


def first_reached(rollouts: Array, rates: Array, goal: float) -> float:
    """Returns the share of rollouts at which a line through rates is first at a goal; 1 if never.

    Example:
        >>> first_reached(np.array([0.0, 10.0, 20.0]), np.array([0.0, 0.5, 0.4]), 0.25)
        0.25
    """
    above = np.flatnonzero(rates >= goal)
    if not len(above):
        return 1.0
    last = int(above[0])
    if not last:
        return 0.0
    part = (goal - rates[last - 1]) / (rates[last] - rates[last - 1])
    return float((rollouts[last - 1] + part * (rollouts[last] - rollouts[last - 1])) / rollouts[-1])


def page(study: Study, uniform: str, dynamic: str, ours: str, trap: str, trapped: str) -> str:
    """Returns tables of all arms in Markdown, and whether the goals were reached."""
    plain = [arm for arm in study.arms if not arm.endswith(trap)]
    faulty = [arm for arm in study.arms if arm.endswith(trap)]
    count = len(study.facts[uniform])
    parts = [
        f"Means over {count} seeds with Student's 95 % intervals, differences in pairs of seeds; "
        "p-values by Holm, over all arms of the table. Rollouts to uniform's final pass rate are "
        "medians of shares of all rollouts, at most 1, with the intervals of "
        "[the report](../intervals.md). Intervals are not corrected.",
        "## All families",
        _versus(study, plain, uniform, None),
        _table(
            [
                "arm",
                "mean along training",
                "rollouts to uniform's final",
                "groups without variance",
                "forgetting of easy levels",
                "seconds of a run",
                "of these the curriculum's",
            ],
            [
                [
                    arm,
                    _mean(study.rate(arm).mean(1)),
                    _shown(median_interval(study.reaching(arm, uniform)), 2),
                    f"{study.facts[arm]['flat'].mean():.2f}",
                    _mean(study.forgotten(arm)),
                    f"{study.facts[arm]['seconds'].mean():.1f}",
                    f"{study.facts[arm]['curriculum_seconds'].mean():.2f}",
                ]
                for arm in plain
            ],
        ),
        "## Family by family",
        "Final pass rate, and below it the median share of all rollouts until uniform's.",
        _table(
            ["arm", *FAMILIES],
            [
                [
                    arm,
                    *(
                        f"{_mean(study.rate(arm, one)[:, -1])}; "
                        f"{_shown(median_interval(study.reaching(arm, uniform, one)), 2)}"
                        for one in FAMILIES
                    ),
                ]
                for arm in plain
            ],
        ),
        "## Predictions before the rollouts",
        "Mean squared error of the expected share of right answers, on the prompts that the arm "
        "has drawn, over all rounds; smaller is better.",
        _predictions(study, ours),
    ]
    if faulty:
        parts += [
            "## The trap",
            f"All answers to `{trapped}` are graded wrong in the first third. Final pass rate of "
            f"`{trapped}`:",
            _versus(study, faulty, uniform + trap, trapped),
        ]
    return "\n\n".join([*parts, "## Goals", _goals(study, uniform, dynamic, ours)]) + "\n"


def picture(study: Study, trap: str, trapped: str) -> bytes:
    """Returns the learning curves of all arms, means over seeds, as a PNG."""
    plain = [arm for arm in study.arms if not arm.endswith(trap)]
    look = looks(plain)

    def draw(figure: FigureBase, family: str | None, faulty: bool) -> None:
        axes = figure.subplots()
        means = []
        for arm in plain:
            name = arm + trap if faulty else arm
            if name in study.curves:
                means.append(study.rate(name, family).mean(0))
                axes.plot(study.rollouts, means[-1], **style(look[arm], len(study.rollouts)))
        finish(axes, "rollouts", "pass rate", means, zero=True)
        axes.set_title(f"{family or 'all'}{trap if faulty else ''}")

    shown: list[tuple[str | None, bool]] = [(None, False), *((one, False) for one in FAMILIES)]
    if any(arm.endswith(trap) for arm in study.arms):
        shown.append((trapped, True))
    panels: list[Callable[[FigureBase], None]] = [
        partial(draw, family=family, faulty=faulty) for family, faulty in shown
    ]
    drawing = Drawing("curves", "Pass rates", "", panels, 3, look)
    (png,) = render(drawing, "png")
    return in_few_colours(png)


def write(folder: Path, results: Sequence[Mapping[str, Any]], **names: str) -> str:
    """Writes runs as tables, a page and a picture; what the page says above the mark stays."""
    facts, curves = tables_of(results)
    folder.mkdir(parents=True, exist_ok=True)
    write_atomically(folder / FACTS, facts.to_csv(index=False, float_format="%.6g").encode())
    packed = lzma.compress(curves.to_csv(index=False).encode(), preset=9)
    write_atomically(folder / CURVES, packed)
    study = read(folder)
    text = page(study, **names)
    file = folder / "README.md"
    above = file.read_text(encoding="utf-8").partition(MARK)[0] if file.is_file() else "# Prompts\n"
    whole = f"{above.strip()}\n\n{MARK}\n\n![Pass rates](curves.png)\n\n{text}"
    write_atomically(file, whole.encode())
    write_atomically(folder / "curves.png", picture(study, names["trap"], names["trapped"]))
    return text


def read(folder: Path) -> Study:
    """Returns the study that :func:`write` left in a folder."""
    curves = pd.read_csv(io.BytesIO(lzma.decompress((folder / CURVES).read_bytes())))
    return Study(pd.read_csv(folder / FACTS), curves)


def results_in(folder: Path, arms: Sequence[str]) -> list[dict[str, Any]]:
    """Returns the finished runs of a folder, in the order of the arms."""
    every = [json.loads(file.read_text()) for file in folder.glob("*_*.json")]
    order = {arm: place for place, arm in enumerate(arms)}
    return sorted(every, key=lambda run: (order[run["arm"]], run["seed"]))


def _versus(study: Study, arms: Sequence[str], other: str, family: str | None) -> str:
    """Returns final pass rates, and their differences to another arm's."""
    last = {arm: study.rate(arm, family)[:, -1] for arm in arms}
    found = {arm: difference_of(last[arm], last[other], True) for arm in arms if arm != other}
    corrected = dict(zip(found, holm([one.p for one in found.values()]), strict=True))
    rows = []
    for arm in arms:
        difference = _shown(found[arm].interval()) if arm in found else "–"
        p = f"{corrected[arm]:.2g}" if arm in found else "–"
        rows.append([arm, _mean(last[arm]), difference, p])
    return _table(["arm", "final pass rate", f"minus {other}", "p (Holm)"], rows)


def _predictions(study: Study, ours: str) -> str:
    column = "error of "
    seen = [arm for arm in study.arms if column + "belief" in study.facts[arm]]
    seen = [arm for arm in seen if study.facts[arm][column + "belief"].notna().all()]
    names = [name[len(column) :] for name in study.facts[seen[0]] if name.startswith(column)]
    rows = []
    for name in names:
        row = [name]
        for arm in seen:
            own, belief = (study.facts[arm][column + one] for one in (name, "belief"))
            off = "" if name == "belief" else f"; ×{_shown(mean_of(own / belief).interval(), 2)}"
            row.append(f"{own.mean():.4f}{off}")
        rows.append(row)
    return _table(["", *(f"on the prompts of {arm}" for arm in seen)], rows)


def _goals(study: Study, uniform: str, dynamic: str, ours: str) -> str:
    """Returns whether each goal was reached, as a list."""
    shares, own = (
        {one: median_interval(study.reaching(arm, uniform, one)) for one in FAMILIES}
        for arm in (ours, uniform)
    )
    reached = [one for one, share in shares.items() if share.estimate <= HALF]
    said = ", ".join(
        f"{one} {_shown(share, 2)} (uniform itself {own[one].estimate:.2f})"
        for one, share in shares.items()
    )
    equal, fewer = (
        difference_of(study.at(ours, 1.0), study.at(dynamic, share), True).interval()
        for share in (1.0, BUDGET)
    )
    facts = study.facts[uniform]
    betas = [str(name) for name in facts if str(name).startswith("error of beta ")][:-1]
    best = min(betas, key=lambda name: float(facts[name].mean()))
    parts = {
        name: mean_of((facts["error of belief"] / facts[name]).to_numpy()).interval()
        for name in dict.fromkeys((betas[0], best))
    }
    blind = mean_of((facts["error of belief, no features"] / facts[best]).to_numpy()).interval()
    errors = "; ".join(f"{_shown(one, 2)} of `{name[9:]}`" for name, one in parts.items())
    verdict = {True: "reached", False: "not reached"}
    against = "undecided" if fewer.low < 0 <= fewer.high else verdict[fewer.low >= 0]
    right = verdict[max(one.high for one in parts.values()) <= FEWER_ERRORS]
    return "\n".join(
        [
            "- Uniform's final pass rate at half of its rollouts on three of four families: "
            f"**{verdict[len(reached) > 2]}**, {len(reached)} of {len(FAMILIES)}: {said}.",
            f"- Not below dynamic sampling that has {BUDGET:.0%} of the rollouts: "
            f"**{against}**, {_shown(fewer)}; at equal rollouts {_shown(equal)}.",
            "- Squared errors of predictions 10 % below the Beta posteriors', on uniform's "
            f"prompts: **{right}**, {errors}; without features, as the Beta posteriors are, "
            f"{_shown(blind, 2)} of `{best[9:]}`.",
        ]
    )


def _mean(values: Array) -> str:
    return _shown(mean_of(values).interval())


def _shown(found: Interval, digits: int = 3) -> str:
    value, low, high = (f"{one:.{digits}f}".replace("-", "−") for one in found)
    return value if low == "nan" else f"{value} \\[{low}, {high}\\]"


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines).replace("_", "\\_")
