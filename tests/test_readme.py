"""What the README shows works as it is written."""

from __future__ import annotations

import io
import re
import shlex
import shutil
from itertools import takewhile
from pathlib import Path

import pytest
from omegaconf import OmegaConf
from PIL import Image

from proposer_rl.cli.eval import main as evaluate_main
from proposer_rl.cli.places import CONFIG_FOLDER
from proposer_rl.cli.report import main as report_main
from proposer_rl.cli.train import main
from proposer_rl.cli.watch import main as watch_main
from proposer_rl.report.curves import cost_curves
from proposer_rl.report.scores import write_scores
from tests.commands import call, trained_run
from tests.report.folders import write_run, write_seconds
from tests.tasks.gymnasium.toys import TINY

DOCS = Path(__file__).parents[1] / "docs"
README = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")


def blocks(language: str, text: str = README) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", text, re.DOTALL)


def commands(program: str) -> list[list[str]]:
    texts = [README, *(file.read_text(encoding="utf-8") for file in DOCS.glob("*.md"))]
    lines = [
        line for text in texts for block in blocks("bash", text) for line in block.splitlines()
    ]
    calls = [shlex.split(line, comments=True) for line in lines]
    found = {tuple(call[1:]) for call in calls if call and call[0] == program}
    # Those that only show settings, or need a folder of the reader's own, are in test_docs.py.
    found = {
        call for call in found if not {"--cfg", "--info", "--config-dir", "--help"} & set(call)
    }
    return [list(call) for call in sorted(found)]


def test_the_code_runs() -> None:
    names: dict[str, object] = {}
    for block in blocks("python"):
        exec(block, names)
    assert {"rollout", "snapshot"} <= names.keys()


def smallest(arguments: list[str]) -> list[str]:
    """The same command at the smallest scale: it is the words that are tested here."""
    small = [re.sub(r"^\+scale=.*", "+scale=smoke", word) for word in arguments]
    small = [re.sub(r"^(seed=\d+),.*", r"\1", word) for word in small]
    for sweep in (word.partition("=")[2] for word in arguments if word.startswith("+sweep=")):
        own = OmegaConf.load(CONFIG_FOLDER / "sweep" / f"{sweep}.yaml").hydra.sweeper.params
        if "task" in own and "," not in own.task:
            small += [f"task={own.task}", "schedule.updates=2"]
        if "checkpoint" in own:
            small += [f"checkpoint={own.checkpoint}"]
    tasks = [word.removesuffix("_quick") for word in small if word.startswith("task=")]
    if not tasks:  # scales are of mazes
        small = [*small, "+scale=smoke"] if "+scale=smoke" not in small else small
    elif (CONFIG_FOLDER / "task" / f"{tasks[0][5:]}_smoke.yaml").exists():
        small = [f"{tasks[0]}_smoke" if word.startswith("task=") else word for word in small]
    else:
        small += TINY
    if any(word.startswith("+sweep=") for word in small):
        # Of a sweep one run, in this process: there may be no cluster here. An ablation or a
        # checkpoint is for the method that is given, or else for the sweep's own.
        own_method = any(word.startswith(("+ablation", "checkpoint=")) for word in small)
        given = r"launcher|^seed=" if own_method else r"launcher|^seed=|^\+method="
        small = [word for word in small if not re.search(given, word)]
        small += ["seed=0", *([] if own_method else ["+method=target"])]
    return small


# Of commands that differ in their scale or their seeds alone, one.
SMALLEST = {
    tuple(sorted(word for word in small if not word.startswith("seed="))): small
    for small in map(smallest, commands("bin/train"))
}


@pytest.mark.parametrize("small", SMALLEST.values(), ids=" ".join)
def test_the_commands_run(
    small: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    before = [
        ["+method=perf_gain", "+scale=smoke", word.replace("checkpoint", "hydra.run.dir")]
        for word in small
        if word.startswith("checkpoint=")
    ]
    for arguments in (*before, small):
        assert call(main, *arguments) == 0
    assert list(tmp_path.rglob("summary.json"))


@pytest.mark.parametrize("program", ["bin/report", "bin/watch"])
def test_the_commands_about_runs_run(
    program: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each command with few figures, all alike: it is the words that are tested here."""
    found = commands(program)
    assert found
    picture = io.BytesIO()
    Image.new("RGB", (100, 100)).save(picture, "PNG")
    monkeypatch.setattr("proposer_rl.report.style._render", lambda *_: picture.getvalue())
    monkeypatch.setattr("proposer_rl.report.build.DRAWINGS", [cost_curves])
    for number, arguments in enumerate(found):
        for folder in takewhile(lambda word: not word.startswith("-"), arguments):
            write_run(tmp_path / str(number) / folder / "run")
        monkeypatch.chdir(tmp_path / str(number))
        if "--scores" in arguments:
            scores = Path(arguments[arguments.index("--scores") + 1])
            scores.parent.mkdir(parents=True, exist_ok=True)
            scores.write_bytes(write_scores([]))
        if "--seconds" in arguments:
            after = arguments[arguments.index("--seconds") + 1 :]
            for file in takewhile(lambda word: not word.startswith("-"), after):
                write_seconds(Path(file), {"target": [1.0]})
        {"bin/report": report_main, "bin/watch": watch_main}[program](arguments)


def test_the_commands_about_levels_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On a Solver of a few updates, and with the file of levels that docs/levels.md shows."""
    monkeypatch.chdir(tmp_path)
    (drawn,) = blocks("text", (DOCS / "levels.md").read_text(encoding="utf-8"))
    Path("my_levels.txt").write_text(drawn)
    trained_run(Path("my_run"), "+method=target", "+scale=smoke")
    found = commands("bin/eval")
    assert found
    for arguments in found:
        if arguments[0] != "my_run":  # a folder with runs in it
            shutil.copytree("my_run", Path(arguments[0], "run"), dirs_exist_ok=True)
        output = Path(arguments[arguments.index("-o") + 1] if "-o" in arguments else "none.csv")
        output.parent.mkdir(parents=True, exist_ok=True)
        output.unlink(missing_ok=True)  # what an earlier command wrote may be of another kind
        evaluate_main(arguments)
    assert Path("scores.csv").is_file() and Path("paths.png").is_file()


def test_the_files_that_it_shows_exist() -> None:
    root = Path(__file__).parents[1]
    for target in re.findall(r"!\[[^\]]*\]\(([^)]+)\)", README):
        assert (root / target).is_file(), target
