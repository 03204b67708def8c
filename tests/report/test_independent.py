"""The report's tables against pandas and SciPy, from nothing but the measurements."""

from __future__ import annotations

import io
import itertools
import math
import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy import integrate, stats

from proposer_rl.report.outcomes import comparison_table, group_table
from proposer_rl.report.statistics import FEWEST, HELD
from proposer_rl.report.studies import read_studies
from tests.committed import RESULTS
from tests.report.folders import write_run

COMMITTED = [
    file.parent
    for file in sorted(RESULTS.glob("*/runs.csv.xz"))
    if file.parent.name != "medium_lives"  # a single run of each
]


def outcomes_of(metrics: pd.DataFrame, columns: pd.Index) -> pd.DataFrame:
    """Every outcome that the table names, of every whole run, indexed by method and seed."""
    (primary,) = (c for c in columns if re.fullmatch(r".*, mean over \d+ updates", c))
    (waiting,) = (c for c in columns if re.fullmatch(r"updates to .* \(at most \d+\)", c))
    horizon = int(primary.split()[-2])
    threshold = float(waiting.split()[2].rstrip("%")) / 100
    headline = primary.partition(",")[0].lower().replace(" ", "_")
    found = {}
    for key, run in metrics.groupby(["method", "seed"]):
        run = run.set_index("updates").sort_index()
        if run.index[-1] >= horizon:
            run = run.loc[:horizon]
            reached = run.index[run[headline] >= threshold]
            found[key] = {
                primary: integrate.trapezoid(run[headline], run.index) / horizon,
                waiting: reached[0] if len(reached) else horizon,
                **{
                    c: run.loc[horizon, c.partition(" after ")[0].lower().replace(" ", "_")]
                    for c in columns
                    if c.endswith(f" after {horizon} updates")
                },
            }
    return pd.DataFrame.from_dict(found, orient="index")


def median(values: pd.Series) -> tuple[float, float, float]:
    """Median, and SciPy's interval of it by the test of a quantile."""
    ends = stats.quantile_test(values, p=0.5).confidence_interval(HELD)
    return values.median(), ends.low, ends.high


def student(values: pd.Series) -> tuple[float, float, float, float]:
    """Mean, interval and p-value; runs that share a value give one degree of freedom at most."""
    if len(values) < FEWEST or values.nunique() == 1:
        return values.mean(), math.nan, math.nan, math.nan
    freedom = max(len(values) - values.value_counts().max(), 1)
    error = stats.sem(values)
    ends = stats.t.interval(0.95, freedom, values.mean(), error)
    return values.mean(), *ends, 2 * stats.t.sf(abs(values.mean()) / error, freedom)


def between(one: pd.Series, other: pd.Series) -> tuple[float, float, float, float]:
    """Difference of two methods' values by seed, in pairs where the seeds are the same."""
    value, paired = one.mean() - other.mean(), one.index.equals(other.index)
    if paired and (len(one) < FEWEST or (one - other).nunique() < len(one)):
        return student(one - other)
    if min(len(one), len(other)) < FEWEST or one.nunique() == other.nunique() == 1:
        return value, math.nan, math.nan, math.nan
    test = stats.ttest_rel(one, other) if paired else stats.ttest_ind(one, other, equal_var=False)
    return value, *test.confidence_interval(), test.pvalue


def holm(p: pd.Series) -> pd.Series:
    """By the definition: the largest q among those up to p, each times how many are not below q."""
    steps = p.map(lambda q: q * (p >= q).sum())
    return p.map(lambda own: min(steps[p <= own].max(), 1))


def check(metrics: pd.DataFrame, methods: pd.DataFrame, pairs: pd.DataFrame, rel: float) -> None:
    """The numbers of both tables that are told with an interval, and the corrected p-values."""
    runs = outcomes_of(metrics, methods.columns)
    of = {method: table.droplevel(0) for method, table in runs.groupby(level=0)}
    assert set(of) == set(methods["method"])
    near = {"rel": rel, "abs": rel, "nan_ok": True}
    for _, row in methods.iterrows():
        for name, values in of[row["method"]].items():
            expected = median(values)
            shown = [row[name], row.get(f"{name}, low", math.nan), row.get(f"{name}, high")]
            assert [math.nan if x is None else x for x in shown] == pytest.approx(expected, **near)
    expected_pairs = list(itertools.combinations(sorted(of), 2))
    found = pd.DataFrame(
        [
            (name, one, other, *between(of[one][name], of[other][name]))
            for name in runs.columns
            for one, other in expected_pairs
            if name == runs.columns[0] or one == expected_pairs[0][0]  # time, and they are alike
        ],
        columns=["outcome", "first", "second", "value", "low", "high", "p"],
    )
    primary = found["outcome"] == runs.columns[0]
    found["corrected"] = holm(found.loc[primary, "p"])
    assert len(pairs) == len(expected_pairs) * len(runs.columns)
    table = found.merge(pairs, on=["outcome", "first", "second"], validate="one_to_one")
    assert len(table) == len(found)
    assert table.loc[~primary, "verdict"].isna().all()
    few = [len(of[one]) < FEWEST or len(of[other]) < FEWEST for one, other in expected_pairs]
    verdicts = pairs.loc[pairs["outcome"] == runs.columns[0], "verdict"]
    assert (verdicts == "too few seeds").tolist() == few
    for _, row in table.iterrows():
        shown = [row["difference"], row["difference, low"], row["difference, high"]]
        assert shown == pytest.approx([row["value"], row["low"], row["high"]], **near)
        # A p-value of millions of differences tells their rounding: its exponent must be right.
        assert row["p (Holm)"] == pytest.approx(row["corrected"], rel=200 * rel, nan_ok=True)
        if str(row["verdict"]).endswith(" is better"):
            winner = row["first"] if row["value"] > 0 else row["second"]
            assert row["verdict"] == f"{winner} is better" and row["corrected"] <= 0.05
        elif row["verdict"] == "no significant difference":
            assert not row["corrected"] <= 0.05


def test_of_runs_with_every_kind_of_seed(tmp_path: Path) -> None:
    """Paired, with other seeds, cut off, too short, too few, and equal throughout."""
    random = np.random.default_rng(5)
    seeds = {"a": range(7), "b": range(7), "c": range(2, 9), "few": range(3), "flat": range(6)}
    speeds = {"a": 1.5, "b": 1.9, "c": 1.2, "few": 1.8, "flat": 0.0}
    curves = {(m, seed): random.gamma(2.0, 0.07, 8) * speeds[m] for m in seeds for seed in seeds[m]}
    folders = {
        tmp_path / f"{method}{seed}": (method, seed, 1 - np.exp(-np.cumsum([0, *steps])))
        for (method, seed), steps in curves.items()
    }
    folders[tmp_path / "short"] = ("a", 77, np.array([0.0, 0.9]))
    for folder, (method, seed, curve) in folders.items():
        write_run(folder, method, [seed], curve, finished=len(curve) > 2)
    study = read_studies(folders, None)[0][0]
    metrics = pd.concat(
        pd.read_csv(folder / "metrics.csv").assign(method=method)
        for folder, (method, *_) in folders.items()
    )
    tables = (pd.read_csv(io.StringIO(t(study).to_csv())) for t in (group_table, comparison_table))
    check(metrics, *tables, rel=1e-5)


LARGE = (
    "arena",
    "curricula",
    "medium",
    "no_oracle",
)  # the others and the runs above protect the same


@pytest.mark.parametrize(
    "folder",
    [
        pytest.param(folder, id=folder.name, marks=[pytest.mark.slow] * (folder.name in LARGE))
        for folder in COMMITTED
    ],
)
def test_of_the_committed_results(folder: Path) -> None:
    runs = pd.read_csv(folder / "runs.csv.xz", keep_default_na=False)
    variant = runs["ablation"].where(runs["ablation"] != "none", "").radd(", ").replace(", ", "")
    labels = dict(zip(runs["run"], runs["method"] + variant, strict=True))
    metrics = pd.read_csv(folder / "metrics.csv.xz")
    studies, notes = read_studies([folder], None)
    assert notes == []
    for study in studies:
        names = {run.folder.relative_to(folder).as_posix() for run in study.runs}
        some = metrics[metrics["run"].isin(names)].dropna(axis=1, how="all")
        found = (group_table, comparison_table)
        tables = (pd.read_csv(io.StringIO(table(study).to_csv())) for table in found)
        check(some.assign(method=some["run"].map(labels)), *tables, rel=1e-5)
