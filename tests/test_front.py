"""The front door: what it shows, and that a run from Python is the run of the command line."""

from __future__ import annotations

import inspect
import json
from concurrent.futures import ThreadPoolExecutor
from datetime import datetime
from functools import partial
from io import BytesIO, TextIOWrapper
from itertools import count
from pathlib import Path
from typing import Any

import pytest
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra

import proposer_rl as prl
from proposer_rl import api
from proposer_rl.cli.eval import main as evaluate
from proposer_rl.cli.play import open_session
from proposer_rl.cli.report import main as report
from proposer_rl.cli.watch import main as watch
from proposer_rl.recipes import CONFIG_FOLDER, own_recipe, recipe_function
from tests.commands import trained_run
from tests.curricula.test_scores import DOTTED, shortfall
from tests.same_run import assert_same_run
from tests.tiny import EXAMPLES

SMOKE = {"scale": "smoke", "progress": False}
CARTPOLE = {
    "max_steps": 20,
    "parameters": {"gravity": {"low": 5.0, "high": 25.0, "bins": 2, "target": 25.0}},
    "success": {"kind": "survived"},
    "evaluation": {"levels": 4},
}


def test_dir_shows_what_there_is() -> None:
    assert {"Teacher", "curricula", "tasks", "train"} < set(dir(prl)) == set(prl.__all__)
    assert all(hasattr(prl, name) for name in dir(prl))
    methods = {file.stem for file in (CONFIG_FOLDER / "method").glob("*.yaml")}
    assert methods < set(dir(prl.curricula)) and {"Filtered", "own"} < set(dir(prl.curricula))
    tasks = {file.stem for file in (CONFIG_FOLDER / "task").glob("*.yaml")}
    assert set(dir(prl.tasks)) == tasks - {"gymnasium"} | {"from_gymnasium", "own"}
    assert all(callable(getattr(prl.curricula, name)) for name in methods)


@pytest.mark.parametrize(
    ("name", "default", "own"),
    [
        ("plr", "temperature", 1.0),  # of the rule by which it draws
        ("plr", "train_on_new", True),  # of its file, and not of the class
        ("accel", "edits", 5),
        ("accel", "capacity", "${pool.capacity}"),  # of the file that it builds on
        ("currot", "delta", 0.3),
        ("model_transport", "delta", 0.2),
        ("model_transport", "labels", "above_worst"),  # of its model
    ],
)
def test_a_recipe_has_the_settings_of_what_makes_it(name: str, default: str, own: Any) -> None:
    make = getattr(prl.curricula, name)
    shown = {p.name: p.default for p in inspect.signature(make).parameters.values()}
    assert shown[default] == own
    assert make.__doc__.partition("\n")[0] in (CONFIG_FOLDER / f"method/{name}.yaml").read_text()
    key = "model" if default == "labels" else "curriculum"
    assert make(**{default: own}).settings == {key: {default: own}}


CLASSES = [
    name
    for name, value in vars(api).items()
    if inspect.isclass(value) and not issubclass(value, Exception)
]


@pytest.mark.parametrize("name", CLASSES)
def test_signatures_of_classes_are_true(name: str) -> None:
    """Each argument is named in the signature, and described in the docstring."""
    made = vars(api)[name]
    described = " ".join(filter(None, (parent.__doc__ for parent in made.__mro__)))
    parameters = list(inspect.signature(made).parameters.values())
    assert all(p.name in described for p in parameters)
    assert [p.name for p in parameters] != ["args", "kwargs"]


def test_a_run_in_a_maze_is_that_of_the_command_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    curriculum = prl.curricula.plr(temperature=0.5, score="max_mc")
    run = prl.train(
        prl.tasks.maze(evaluation={"levels": 8}),
        curriculum,
        filter="learnability",
        seed=3,
        settings={"solver": {"ppo": {"learning_rate": 0.002}}},
        folder=tmp_path / "python",
        **SMOKE,
    )
    same = trained_run(
        tmp_path / "shell",
        *("+method=plr", "+scale=smoke", "+filter=learnability", "seed=3", "task=maze"),
        *("curriculum.temperature=0.5", "curriculum.score=max_mc", "task.evaluation.levels=8"),
        *("solver.ppo.learning_rate=0.002", "compute.progress=false"),
    )
    assert_same_run(run.folder, same)
    assert (run.folder / "config.json").read_text() == (same / "config.json").read_text()
    assert run.metrics["updates"].iloc[-1] == run.summary["updates"]
    assert len(run.training) == len(run.metrics) - 1 and run.picture.parent == run.folder
    levels = run.task().target.sample(2, __import__("torch").Generator())
    assert run.solver().copies == 1 and levels.batch_size == (2,)
    capsys.readouterr()
    watch([str(run.folder), "--once"])
    assert "6/6" in capsys.readouterr().out
    evaluate([str(run.folder), "--levels", "id", "-o", str(tmp_path / "rows.json")])
    monkeypatch.setattr("proposer_rl.report.build.DRAWINGS", [])
    report([str(run.folder), "-o", str(tmp_path / "report")])
    assert (tmp_path / "report" / "report.html").exists()
    assert open_session(run.folder).about()["board"] is not None


def test_a_curriculum_need_not_be_chosen(tmp_path: Path) -> None:
    run = prl.train("maze", updates=3, folder=tmp_path / "run", **SMOKE)
    config = json.loads((run.folder / "config.json").read_text())
    assert config["method"] == prl.DEFAULT_METHOD in dir(prl.curricula)
    space = prl.Parameters({"gravity": (5.0, 25.0)})  # a space is enough, too
    assert 5 <= prl.Teacher(prl.DEFAULT_METHOD, space).ask()[1]["gravity"] <= 25


def test_a_run_on_gymnasium_goes_on_in_its_folder(tmp_path: Path) -> None:
    def train(updates: int, folder: str, **annealed: Any) -> prl.Run:
        task = prl.tasks.from_gymnasium("CartPole-v1", **CARTPOLE)
        ppo = {"horizon": 20, "epochs": 1, **annealed}
        settings = {"solver": {"ppo": ppo}, "schedule": {"evaluate_every": 2}}
        return prl.train(
            task,
            prl.curricula.learning_progress(source="episodes"),
            updates=updates,
            folder=tmp_path / folder,
            settings=settings,
            progress=False,
        )

    steady = {"anneal_updates": None}
    train(2, "parts", **steady)
    run = train(4, "parts", **steady)
    assert list(run.metrics["updates"]) == [0, 2, 4]
    assert_same_run(run.folder, train(4, "whole", **steady).folder)
    train(1, "falling")
    with pytest.raises(ValueError, match=r"anneal_updates=2: .* a longer run needs a new folder$"):
        train(2, "falling")


class Frozen(datetime):
    """A clock that stands still."""

    @classmethod
    def now(cls, tz: Any = None) -> Any:
        return cls(2026, 1, 1)


def test_runs_of_one_second_have_folders_of_their_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And where signs are printed that standard output does not have, they end well."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("proposer_rl.cli.compose.datetime", Frozen)
    for encoding in ("ascii", "latin-1"):
        out = TextIOWrapper(BytesIO(), encoding)
        monkeypatch.setattr("sys.stdout", out)
        prl.train("maze", "target", updates=1, **SMOKE)
        watch(["outputs", "--once"])
        monkeypatch.undo()
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr("proposer_rl.cli.compose.datetime", Frozen)
        out.flush()
        assert "target, seed 0" in out.buffer.getvalue().decode(encoding)  # type: ignore[attr-defined]
    found = sorted(folder.name for folder in Path("outputs/target").iterdir())
    assert found == ["2026-01-01_00-00-00_seed_0", "2026-01-01_00-00-00_seed_0_2"]


def test_tasks_and_curricula_of_ones_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(EXAMPLES)
    from own_curriculum import Again
    from own_task import SledgeTask

    sledges = {"solver": {"batch_size": 4, "ppo": {"horizon": 8}}}
    task = prl.tasks.own(SledgeTask, levels=8)
    run = prl.train(task, "plr", updates=2, folder=tmp_path / "1", settings=sledges, progress=False)
    assert "target_success" in run.metrics
    assert type(run.task()).__name__ == "SledgeTask"
    curriculum = prl.curricula.own(Again)
    run = prl.train("maze", curriculum, updates=2, folder=tmp_path / "2", **SMOKE)
    assert run.summary["method"] == "Again"


def test_a_score_of_ones_own_in_a_run_and_in_a_teacher(tmp_path: Path) -> None:
    small: dict[str, Any] = {"score": shortfall, "capacity": 16, "fill": 0.5}
    curriculum = prl.curricula.plr(**small)
    run = prl.train("maze", curriculum, updates=2, folder=tmp_path / "python", **SMOKE)
    words = ["+method=plr", "+scale=smoke", "curriculum.capacity=16", "curriculum.fill=0.5"]
    words += [f"curriculum.score={DOTTED}", "schedule.updates=2", "compute.progress=false"]
    assert_same_run(run.folder, trained_run(tmp_path / "shell", *words))
    assert json.loads((run.folder / "config.json").read_text())["curriculum"]["score"] == DOTTED

    around = {"score": lambda student, outcome: -outcome["return"], "source": "episodes"}
    teacher = prl.Teacher(
        curriculum,
        prl.Parameters({"gravity": (0.0, 1.0)}),
        filter={**around, "times": 2},
        block=8,
        play=lambda levels, generator: {"return": levels["gravity"]},
    )
    ids, levels = teacher.ask(8)
    teacher.tell(ids, levels["gravity"])
    teacher.ask(8)  # by which the outcomes have been taken
    mean = float(1 - levels["gravity"].mean())
    assert teacher.log()["mean_score"] == pytest.approx(mean)
    assert teacher.state_dict()["of"]["curriculum"]["score"] == "shortfall"
    prl.Teacher(prl.curricula.plr(score=partial(shortfall)), teacher.space).ask()  # has no name


def test_what_cannot_be_imported_again_is_refused(tmp_path: Path) -> None:
    with pytest.raises(prl.ArgumentError, match="must be importable"):
        own_recipe("method", lambda parts: None)
    curriculum = prl.curricula.plr(score=lambda student, outcome: outcome["return"])
    with pytest.raises(prl.ArgumentError, match=r"^curriculum=.*: must be importable"):
        prl.train("maze", curriculum, folder=tmp_path / "run", **SMOKE)


@pytest.mark.parametrize(
    ("task", "more", "message"),
    [
        ("CartPole-v1", {}, "task='CartPole-v1': must be prl.tasks.NAME(...), from_gymnasium"),
        (prl.tasks.maze, {}, "task=<function maze"),
        ("maze", {"curriculum": "plrr"}, "curriculum='plrr': must be prl.curricula.NAME(...) or "),
        ("maze", {"scale": "tiny"}, "scale/tiny: unknown; there are: "),
        ("maze", {"filter": True}, "filter=True: input should be an object, or a valid string"),
        ("maze", {"settings": {"seed": object()}}, "seed=<object object at"),
        ("maze", {"settings": ["seed"]}, "settings=['seed']: input should be an object"),
        ("maze", {"updates": {1}}, "schedule={'updates': {1}}: must be a number, a text, a list"),
    ],
)
def test_bad_input_is_one_line_and_leaves_nothing(
    task: Any, more: dict[str, Any], message: str, tmp_path: Path
) -> None:
    with pytest.raises(prl.ArgumentError) as refused:
        prl.train(task, folder=tmp_path / "run", **{"curriculum": "plr", **SMOKE, **more})
    assert str(refused.value).startswith(message) and "\n" not in str(refused.value)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("make", "given", "message"),
    [
        (prl.curricula.plr, {"temprature": 1}, "temprature: unknown; there are: score, source"),
        (prl.curricula.target, {"temperature": 1}, "temperature: unknown; there are: none"),
        (recipe_function("task", "gymnasium"), {"max_steps": 3}, "env_id: missing"),
    ],
)
def test_settings_of_recipes_are_checked_where_they_are_given(
    make: Any, given: dict[str, Any], message: str
) -> None:
    with pytest.raises(prl.ArgumentError, match=f"^{message}"):
        make(**given)


def test_runs_in_threads_are_those_that_they_are_alone(tmp_path: Path) -> None:
    """As Optuna's n_jobs=2 and asyncio.to_thread make them (hydra#2010, optuna#1727)."""

    def train(where: str, seed: int, method: str) -> prl.Run:
        folder = tmp_path / where / method
        return prl.train("maze", method, seed=seed, updates=2, folder=folder, **SMOKE)

    methods = ["plr", "target", "perf_gain"]
    with ThreadPoolExecutor(len(methods)) as pool:
        runs = list(pool.map(partial(train, "threads"), count(), methods))
    for seed, (method, run) in enumerate(zip(methods, runs, strict=True)):
        said = json.loads((run.folder / "run.json").read_text())
        assert {f"+method={method}", f"seed={seed}"} <= {*said["overrides"]}
        assert_same_run(run.folder, train("alone", seed, method).folder)


def test_a_run_is_read_wherever_the_process_is_by_then(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    runs = [
        prl.train("maze", "target", updates=1, folder=folder, **SMOKE)
        for folder in (None, "run", "~/run")
    ]
    assert not Path("~").exists() and Path("home/run/summary.json").exists()
    runs += [prl.Run("run"), prl.Run(Path("home", "run"))]
    monkeypatch.chdir(tmp_path.parent)
    assert all(run.folder.is_absolute() and len(run.metrics) == 2 for run in runs)
    assert runs[1].summary["updates"] == 1 and runs[1].solver().copies == 1
    assert runs[1] == runs[3]


def test_the_package_that_is_named_as_a_tasks_file_says_so() -> None:
    with pytest.raises(TypeError, match=r"call prl.tasks.from_gymnasium\(env_id, ...\)$"):
        prl.tasks.gymnasium(env_id="CartPole-v1")


def test_a_hydra_around_a_run_is_left_as_it_was(tmp_path: Path) -> None:
    with initialize_config_dir(str(CONFIG_FOLDER), version_base="1.3"):
        prl.train("maze", "target", updates=1, folder=tmp_path / "run", **SMOKE)
        assert compose("train", ["seed=7"]).seed == 7
    assert not GlobalHydra.instance().is_initialized()
