"""What a task cannot give, or must not be asked, and files that would be misread: one line."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from proposer_rl.cli.loggers import wandb_id
from tests.tasks.gymnasium.toys import TINY, WALK

CARS = ["task=cartpole", *TINY]
VIEWS = ["task=view_maze_smoke", "compute.progress=false"]
SEEDS = ["task=gymnasium", f"task.env_id={WALK}", "task.success.kind=terminated", *TINY]
REFUSED = [
    ([*CARS, "+method=regret"], "GymnasiumTask must define optimal_return(levels)"),
    ([*CARS, "+method=plr", "compute.collector=multiprocess"],
     "this method trains no replicas in workers; leave compute.collector=single"),
    ([*SEEDS, "+method=plr", "+filter=model"], "space: must have axes"),
    ([*VIEWS, "+method=regret"], "needs a student with exact_performance: ViewMazeTask"),
    ([*VIEWS, "+method=target", "task.maze.height=4"], "ood: perfect mazes have odd"),
    ([*VIEWS, "+method=target", "task.space.walls=[24]"], "space: 5x5 cells have at most 23"),
]  # fmt: skip

FIRST = "# @package _global_\n"
WIDTH = "    width: {set: argument, values: [1.0, 2.0], target: 2.0}\n"
FILE = f"""\
defaults: [gymnasium, _self_]
task:
  env_id: {WALK}
  parameters:
{WIDTH}  success: {{kind: terminated}}
"""
WHOLE = FIRST + FILE
MISREAD = [
    (FILE.encode(), "line.yaml must be '# @package _global_'"),
    (WHOLE.encode("utf-8-sig"), "with no byte-order mark before it"),
    (("# a note\n" + WHOLE).encode(), "line.yaml must be '# @package _global_'"),
    (("# Größe\n" + WHOLE).encode("latin-1"), "'utf-8' codec can't decode"),
    (WHOLE.replace("defaults: [gymnasium, _self_]", "").encode(),
     "task._target_: missing: the class or function that makes the task; a file of your own"),
]  # fmt: skip

pytestmark = pytest.mark.usefixtures("own_folder")


@pytest.fixture
def refused(train: Any, capsys: pytest.CaptureFixture[str]) -> Any:
    """Returns the only line of a command that must not begin a run."""

    def line(*words: str) -> str:
        assert train(*words, "hydra.run.dir=run") == 2
        assert not Path("run", "run.json").exists()
        (said,) = capsys.readouterr().err.strip().splitlines()
        return said

    return line


@pytest.mark.parametrize(("words", "said"), REFUSED)
def test_what_a_task_lacks_is_refused_before_a_run_begins(
    words: list[str], said: str, refused: Any
) -> None:
    assert said in refused(*words)


@pytest.mark.parametrize(("content", "said"), MISREAD)
def test_a_file_that_would_be_misread_is_refused(content: bytes, said: str, refused: Any) -> None:
    folder = Path("conf/task")
    folder.mkdir(parents=True)
    (folder / "line.yaml").write_bytes(content)
    changed = TINY if b"defaults" in content else []  # what is not there cannot be changed
    line = refused("--config-dir=conf", "task=line", "+method=target", *changed)
    assert line.startswith("error: ") and said in line


def test_a_run_keeps_its_name_at_weights_and_biases() -> None:
    first, other = Path("a"), Path("b")
    for folder in (first, other):
        folder.mkdir()
    assert wandb_id(first) == wandb_id(first) != wandb_id(other)
