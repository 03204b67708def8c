"""The same seed gives the same bytes, whatever else is different."""

from __future__ import annotations

import random
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.commands import SMOKE
from tests.same_run import assert_same_run, tables, trained

pytestmark = pytest.mark.usefixtures("own_folder")

FEW = [*SMOKE, "solver.ppo.epochs=2", "schedule.updates=3"]
METHODS = ["perf_gain", "target", "adaptive_mixture"]


def assert_trained_alike(one: Path, other: Path) -> None:
    first, second = trained(one), trained(other)
    assert first.keys() == second.keys()
    assert all(torch.equal(first[name], second[name]) for name in first)


@pytest.fixture(autouse=True)
def _one_thread_afterwards():
    yield
    torch.set_num_threads(1)


@pytest.fixture(scope="module")
def wholes() -> dict[str, Path]:
    """Of each method the run that the others are compared with; they only read it."""
    return {}


@pytest.fixture
def whole(
    train, method: str, wholes: dict[str, Path], tmp_path_factory: pytest.TempPathFactory
) -> Path:
    if method not in wholes:
        folder = tmp_path_factory.mktemp(method)
        assert train(f"+method={method}", *FEW, f"hydra.run.dir={folder}") == 0
        wholes[method] = folder
    return wholes[method]


@pytest.mark.parametrize("method", METHODS)
def test_no_byte_depends_on_how_it_is_computed_logged_or_saved(
    method: str, whole: Path, train
) -> None:
    """Nor on global generators, which are neither used nor changed: every draw is of the seed."""
    otherwise = ["compute.cores=1", "logger=tensorboard", "schedule.checkpoint_seconds=1e-6"]
    torch.manual_seed(123)
    np.random.seed(123)
    random.seed(123)
    before = torch.get_rng_state(), np.random.get_state()[1].tolist(), random.getstate()
    assert train(f"+method={method}", *FEW, *otherwise, "hydra.run.dir=other") == 0
    assert_same_run(whole, Path("other"))
    assert torch.equal(torch.get_rng_state(), before[0])
    assert (np.random.get_state()[1].tolist(), random.getstate()) == before[1:]


@pytest.mark.parametrize("method", METHODS)
def test_measuring_more_or_less_does_not_change_training(method: str, whole: Path, train) -> None:
    options = ["task.evaluation.levels=3", "schedule.evaluate_every=1"]
    assert train(f"+method={method}", *FEW, *options, "hydra.run.dir=other") == 0
    assert_trained_alike(whole, Path("other"))
    assert tables(whole) != tables(Path("other"))


def test_several_threads_give_the_same_bytes_every_time(train) -> None:
    options = ["compute.threads=2", "schedule.updates=2"]
    for name in ("one", "other"):
        assert train("+method=target", *FEW, *options, f"hydra.run.dir={name}") == 0
    assert_same_run(Path("one"), Path("other"))


@pytest.mark.parametrize("method", METHODS)
def test_the_seed_reaches_every_draw(method: str, whole: Path, train) -> None:
    assert train(f"+method={method}", *FEW, "seed=1", "hydra.run.dir=other") == 0
    one, other = trained(whole), trained(Path("other"))
    weights = [name for name in one if name.endswith("/value")]
    # Biases begin at zero whatever the seed, but are trained on other levels by other actions.
    assert all(not torch.equal(one[name], other[name]) for name in weights if one[name].any())
    assert tables(whole)["curriculum.jsonl"] != tables(Path("other"))["curriculum.jsonl"]
