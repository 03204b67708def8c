"""Wrong input: one line that names key, value and what is allowed, and nothing written."""

from __future__ import annotations

import json
import pickle
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

from proposer_rl.cli.build import parts
from proposer_rl.cli.config import read_config, saved_config
from proposer_rl.cli.errors import (
    BAD_INPUT,
    UNFORESEEN,
    ConfigError,
    exit_code,
    one_line,
)
from proposer_rl.cli.groups import arranged
from proposer_rl.extras import install_command
from proposer_rl.recipes import CONFIG_FOLDER
from proposer_rl.runs.folder import TABLES
from proposer_rl.runs.process import StopSignals
from tests.commands import trained_run
from tests.same_run import assert_same_run
from tests.tiny import composed

pytestmark = pytest.mark.usefixtures("own_folder")

SMOKE = ["+scale=smoke", "compute.progress=false"]
PARSER = OverridesParser.create()
METHODS = ", ".join(sorted(file.stem for file in (CONFIG_FOLDER / "method").glob("*.yaml")))

# Changes to the settings of +method=target, and what the line must say; one of each kind.
WRONG = [
    ("task.network.channels=[8,x]", "task.network.channels.1='x': input should be a valid integer"),
    ("solver.batch_size=0", "solver.batch_size=0: input should be greater than or equal to 1"),
    ("schedule.threshold=1.5", "threshold=1.5: must be above 0 and at most 1, as id_success is"),
    ("task.network={channels:[1000000],groups:1}", "the run does not fit in memory: "),
    ("compute.device=abacus", "compute.device=abacus: Expected one of cpu, cuda"),
    ("schedule.headline=fun", "headline='fun': must be one of ['id_success'"),
    # unknown keys
    ("solver.ppo.gama=1", "solver.ppo.gama: unknown; there are: adam_eps, anneal_"),
    ("+curriculum.x=1", "curriculum.x: unknown; there are: none"),
    ("seed=${nowhere}", "Interpolation key 'nowhere' not found full_key: seed"),
    ("task.target=???", "Missing mandatory value: task.target"),
    # contradictions
    ("solver.ppo.minibatches=129", "solver.ppo.minibatches=129: must be at most the 128"),
    # what a method is made of
    (
        "curriculum._target_=my_parts.make",
        f"curriculum: No module named 'my_parts'; {sys.executable} cannot find it: install it "
        "there, or, if it is your own, put its folder on PYTHONPATH, as in PYTHONPATH=. bin/train "
        "...",
    ),
    ("task._target_=my_parts.make", "task: No module named 'my_parts'; "),
    ("curriculum._target_=os.system", "curriculum: Target 'os.system' is"),
]
WRONG_COMMANDS = [
    (["+method=target", "task.network=[8]"], "override task.network=[8]: Cannot merge DictConfig"),
    (["--config-dir", "nowhere", "+method=target"], "nowhere' not found"),
    (["+method=target", "sede=1"], "sede: unknown; there are: ablation, checkpoint, compute,"),
    (["+method=target", "task.network=[1,2"], "error: task.network=[1,2: "),
    (["+method=target", "hydra.run.dir=runs/é"], "error: hydra.run.dir=runs/é: "),
    (["+method=target", "seeds=[1,1]"], "seeds=[1, 1]: must be distinct"),
    (["task=cartpole", "+method=target", "+scale=medium"], "scale=medium: is a scale of task=maze"),
    ([], f"method: missing; choose one with +method=NAME, NAME one of: {METHODS}"),
    (["+method=magic"], f"method/magic: unknown; there are: {METHODS}"),
    (
        ["+method=paired", "proposer/action=problems", "proposer.action.ratio=joint"],
        "proposer.action.ratio=joint: here each draw is rewarded by itself",
    ),
    (
        ["+method=hand_designed", "hand_designed.distributions=[x]"],
        "curriculum.distributions.x: unknown; there are: id, ood, mix",
    ),
    (["+method=target", "checkpoint=other"], "checkpoint=other: has no effect with method=target"),
    (
        ["task=cartpole", "+method=target", "+filter=learnability"],
        "method=target needs a student with exact_performance: GymnasiumTask measures",
    ),
    (
        ["+method=perf_gain", *SMOKE, "proposer.action_repeat=2"],
        "action_repeat=2 must divide meta_episode_length=3",
    ),
    (
        ["+method=task_difficulty", *SMOKE, "+ablation=paper_literal"],
        "curriculum.reward: unknown; there are: checkpoint",
    ),
    (["+method=target", "compute.collector=ray"], "compute.collector=ray: this method trains no"),
    (
        ["+method=frozen_proposer", *SMOKE],
        "curriculum.checkpoint=None: input should be a valid string",
    ),
    (
        ["+method=frozen_proposer", *SMOKE, "checkpoint=nowhere"],
        "curriculum.checkpoint=nowhere: cannot read nowhere: No such file or directory",
    ),
    (
        ["+method=frozen_proposer", *SMOKE, "checkpoint=."],
        "curriculum.checkpoint=.: the folder holds no checkpoints and no proposer.pt",
    ),
]


def test_a_pickle_is_never_read(train, capsys) -> None:
    """argparse takes abbreviations of an option (fractal-client#440)."""
    Path("job.pickle").write_bytes(b"cos\nmkdir\n(S'executed'\ntR.")
    for words in (["--experimental-rerun", "job.pickle"], ["--exp=job.pickle"]):
        assert train(*words) == 2
        assert capsys.readouterr().err.startswith("error: --experimental-rerun: not supported")
    assert not Path("executed").exists()


@pytest.mark.parametrize(
    "options",
    [["--config-path", "my_conf"], ["--config-name", "hill"], ["--config-dir", "my_conf/task"]],
)
def test_files_of_ones_own_are_found_below_config_dir(options: list[str], train, capsys) -> None:
    Path("my_conf/task").mkdir(parents=True)
    assert train(*options, "task=hill", "+method=plr") == 2
    assert capsys.readouterr().err.endswith("as in: --config-dir my_conf task=hill\n")


@pytest.mark.parametrize(
    ("words", "taken"),
    [
        (["curriculum.x=1", "~model.y"], ["++curriculum.x=1", "~model.y"]),
        (["+as=dcd", "++method=plr", "seed=1"], ["as=dcd", "method=plr", "seed=1"]),
        (["task=a,b", "~filter", "filter={times: 3}"],) * 2,
        (["+own_group=x", "+task.maze.y=1"],) * 2,
    ],
)
def test_overrides_are_spelled_as_hydra_takes_them(words: list[str], taken: list[str]) -> None:
    assert arranged(words) == taken == arranged(taken)


@pytest.mark.parametrize(
    ("groups", "ablation"),
    [
        (["+method=perf_gain", "+scale=smoke", "+ablation=paper_literal"], "paper_literal"),
        (["task=maze", "+method=plr", "+as=dcd", "+score=model"], "model_scores"),
    ],
)
def test_groups_have_the_same_effect_in_any_order(groups: list[str], ablation: str) -> None:
    made = composed(*groups)
    assert made.ablation == ablation
    assert made == composed(*reversed(groups))


@pytest.mark.parametrize("word", ["task=null", "filter=null", "+filter=none,null", "+scale=3"])
def test_a_group_without_a_files_name_gets_one_line(word: str, train, capsys) -> None:
    """As of every other key, with what it takes (lightning-hydra-template#629)."""
    assert train("+method=target", word) == 2
    assert capsys.readouterr().err.startswith(f"error: {word}: names no file; choose one of: ")


def begun(*arguments: Any) -> float:
    """In the place of a run: none of these may begin, least of all one of the paper's size."""
    raise AssertionError("the input was taken for valid")


@pytest.fixture(scope="module")
def target() -> bytes:
    """The settings of ``+method=target``, as they stand in its files; others are made of copies."""
    GlobalHydra.instance().clear()
    with initialize_config_dir(str(CONFIG_FOLDER), version_base="1.3"):
        return pickle.dumps(compose("train", ["method=target"]))


@pytest.mark.parametrize(("change", "message"), WRONG)
def test_a_wrong_value_is_refused_in_a_line_that_names_it(
    change: str, message: str, target: bytes
) -> None:
    config = pickle.loads(target)
    override = PARSER.parse_override(change)
    OmegaConf.update(config, override.key_or_group, override.value(), force_add=True)
    with pytest.raises(Exception) as refused:
        parts(read_config(config), StopSignals())
    assert exit_code(refused.value) == BAD_INPUT
    assert message in one_line(refused.value)


@pytest.mark.parametrize(("arguments", "message"), WRONG_COMMANDS)
def test_bad_input_gets_one_line_and_exit_code_2(
    arguments, message, train, capsys, monkeypatch
) -> None:
    monkeypatch.setattr("proposer_rl.cli.run.proceed", begun)
    assert train(*arguments, "hydra.run.dir=run") == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert line.startswith("error: ")
    assert message in line
    assert not (Path("run") / "config.json").exists()


def test_a_file_of_ones_own_that_is_no_yaml_gets_one_line(train, capsys, tmp_path: Path) -> None:
    (tmp_path.parent / f"{tmp_path.name}_conf" / "method").mkdir(parents=True)
    file = tmp_path.parent / f"{tmp_path.name}_conf" / "method" / "own.yaml"
    file.write_text("# @package _global_\nmethod: own\ncurriculum: {_target_: [\n")
    assert train("--config-dir", str(file.parents[1]), "+method=own") == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert line.startswith("error: ") and f'"{file}", line 4' in line


def test_a_value_may_refer_to_another(train) -> None:
    arguments = ["+method=target", *SMOKE, "solver.batch_size=1"]
    arguments.append("schedule.updates=${solver.batch_size}")
    assert train(*arguments, "hydra.run.dir=run") == 0
    found = json.loads(Path("run/run.json").read_text())
    assert found["planned_updates"] == 1
    assert found["overrides"] == arguments
    assert "method" in found["about"] and "ablation" not in found["about"]


def test_without_ray_its_collector_is_refused(train, capsys, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)  # as if it were not installed
    assert train("+method=perf_gain", "compute.collector=ray", "hydra.run.dir=run") == 2
    line = f"error: compute.collector=ray needs ray; install with: {install_command('ray')}"
    assert capsys.readouterr().err.strip() == line


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of two updates."""
    folder = tmp_path_factory.mktemp("finished") / "run"
    return trained_run(folder, "+method=target", *SMOKE, "schedule.updates=2")


def refused(train, capsys, *arguments: str) -> str:
    """The line that a resumed run is refused with; nothing is changed by it."""
    files = [Path("run", name) for name in ("config.json", *TABLES)]
    kept = {file: file.read_bytes() for file in files if file.exists()}
    assert train("+method=target", *SMOKE, "hydra.run.dir=run", *arguments) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert {file: file.read_bytes() for file in kept} == kept
    return line


def stored(change: Callable[[dict[str, Any]], Any]) -> Callable[[bytes], bytes]:
    """Changes what a run has stored of its configuration."""

    def changed(content: bytes) -> bytes:
        change(config := json.loads(content))
        return json.dumps(config).encode()

    return changed


CHANGED: list[tuple[str, Callable[[bytes], bytes], list[str], str]] = [
    (
        *("config.json", bytes, ["solver.ppo.gamma=0.5", "task.maze.max_steps=9"]),
        "started with 0.99; differing keys: solver.ppo.gamma, task.maze.max_steps",
    ),
    ("config.json", stored(lambda c: c.update(lifetimes=1)), [], "lifetimes=None: the run in "),
    (
        "config.json",
        stored(lambda config: config["task"]["network"].update(channels=[8, 8])),
        ["task.network.channels=[8,8]"],
        "does not fit this run: the snapshot belongs to",
    ),
    ("config.json", lambda _: b"{", [], "config.json: Expecting property name"),
    ("config.json", lambda _: b"[1]", [], "started with [1]"),
    ("metrics.csv", lambda _: b"seed\n", [], "metrics.csv has 0 rows, fewer than the 2 to be kept"),
]


@pytest.mark.parametrize(("file", "change", "arguments", "message"), CHANGED)
def test_a_run_that_is_another_is_not_resumed(
    file: str,
    change: Callable[[bytes], bytes],
    arguments: list[str],
    message: str,
    finished: Path,
    train,
    capsys,
) -> None:
    shutil.copytree(finished, "run")
    (Path("run") / "summary.json").unlink()
    path = Path("run", file)
    path.write_bytes(change(path.read_bytes()))
    assert message in refused(train, capsys, *arguments)
    if "lifetimes" in message:
        with pytest.raises(ConfigError, match=r"of this version: lifetimes: unknown"):
            saved_config(Path("run"))


def test_a_stored_configuration_instantiates_nothing(finished: Path, train, capsys) -> None:
    """Neither the one that is compared, nor Hydra's own copies, which nobody reads."""
    folder = Path(shutil.copytree(finished, "run"))
    evil = {"_target_": "os.mkdir", "path": str(Path("executed").resolve())}
    stored = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps({**stored, "curriculum": evil}))
    (folder / ".hydra").mkdir(exist_ok=True)
    for name in ("config", "overrides", "hydra"):
        (folder / ".hydra" / f"{name}.yaml").write_text(
            "curriculum: !!python/object/apply:os.mkdir [executed]"
        )
    assert "curriculum._target_='proposer_rl.methods.target': the run in" in refused(train, capsys)
    assert not Path("executed").exists()
    (folder / "config.json").write_text(json.dumps(stored))
    assert train("+method=target", *SMOKE, "hydra.run.dir=run") == 0
    assert not Path("executed").exists()


def test_a_folder_with_tables_of_something_else_is_left_alone(train, capsys) -> None:
    Path("run").mkdir()
    Path("run/training.csv").write_text("year\n1\n")
    assert "holds training.csv but no config.json" in refused(train, capsys)
    assert Path("run/training.csv").read_text() == "year\n1\n"


def test_what_may_differ_in_a_resumed_run(finished: Path, train) -> None:
    folder = Path(shutil.copytree(finished, "run"))
    free = ["schedule.checkpoint_seconds=null", "schedule.keep_checkpoints=3", "compute.cores=1"]
    few = [*SMOKE, "schedule.updates=4"]
    assert train("+method=target", *few, "hydra.run.dir=run", *free) == 0
    assert train("+method=target", *few, "hydra.run.dir=whole") == 0
    assert_same_run(Path("whole"), folder)


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (RuntimeError("can't allocate memory:\nyou tried to allocate 9 bytes"), BAD_INPUT),
        (torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 9 GiB."), BAD_INPUT),
        (MemoryError("9 GiB"), BAD_INPUT),
        (RuntimeError("the buffer is allocated on another device"), UNFORESEEN),
    ],
)
def test_running_out_of_memory_is_no_defect(error: Exception, code: int) -> None:
    assert exit_code(error) == code
    assert one_line(error).startswith("the run does not fit in memory: ") == (code == BAD_INPUT)
