"""Task files of one's own: what cannot be read as it stands is refused in a line that names it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from proposer_rl.cli.loggers import wandb_id
from tests.tasks.gymnasium.toys import TINY

FIRST = "# @package _global_\n"
WIDTH = "    width: {set: argument, values: [1.0, 2.0], target: 2.0}\n"
FILE = f"""\
defaults: [gymnasium, _self_]
task:
  env_id: tests.tasks.gymnasium.toys:Walk-v0
  parameters:
{WIDTH}  success: {{kind: terminated}}
"""
AXES = "".join(f"    p{i}: {{set: option, values: [0], target: 0}}\n" for i in range(9))
PARAMETERS = "  parameters:\n"


@pytest.mark.usefixtures("own_folder")
@pytest.mark.parametrize(
    ("content", "said"),
    [
        (FILE.encode(), "line.yaml must be '# @package _global_'"),
        ((FIRST + FILE).encode("utf-8-sig"), "byte-order mark hides it: save the file as UTF-8"),
        (("# a note\n" + FIRST + FILE).encode(), "line.yaml must be '# @package _global_'"),
        (("# Größe\n" + FIRST + FILE).encode("latin-1"), "line.yaml: is not encoded in UTF-8"),
        (
            (FIRST + FILE.replace("defaults: [gymnasium, _self_]", "")).encode(),
            "task._target_: missing: the class that makes the task; a file of one's own has it",
        ),
        ((FIRST + FILE).encode("utf-16"), "line.yaml: is not encoded in UTF-8"),
        ((FIRST + FILE).encode("utf-16-le"), "line.yaml"),
        ((FIRST + FILE.replace("  env_id", "\tenv_id")).encode(), "line.yaml"),
        (
            (FIRST + FILE).replace("values: [1.0, 2.0]", "low: 1, high: 2, bins: 257").encode(),
            "task.parameters.width.bins=257: input should be less than or equal to 256",
        ),
        (
            (FIRST + FILE.replace("target: 2.0", "target: .nan")).encode(),
            "task.parameters.width.target=nan: must be finite",
        ),
        (
            (FIRST + FILE + "  transforms: [{_target_: torchrl.envs.NoSuch}]\n").encode(),
            "task.transforms: Error locating target 'torchrl.envs.NoSuch'",
        ),
        (
            (FIRST + FILE.replace(f"{PARAMETERS}{WIDTH}", "  parameters: [width]\n")).encode(),
            "task/line: a list where there must be a mapping, {NAME: VALUE} (it has lists in "
            "task.parameters)",
        ),
        *(
            (
                (FIRST + FILE.replace("width:", f"{name}:")).encode(),
                f"task.parameters: {read} without quotes is no name here; a name has quotes",
            )
            for name, read in {
                "on": "on, yes or true",
                "No": "off, no or false",
                "~": "null or ~",
            }.items()
        ),
        (
            (FIRST + FILE.replace(PARAMETERS, PARAMETERS + AXES)).encode(),
            "task: space: Dictionary should have at most 8 items",
        ),
    ],
)
def test_a_file_that_would_be_misread_is_refused(
    content: bytes, said: str, train: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = Path("conf/task")
    folder.mkdir(parents=True)
    (folder / "line.yaml").write_bytes(content)
    changed = TINY if b"defaults" in content else []  # what is not there cannot be changed
    run = ["--config-dir=conf", "task=line", "+method=target", *changed, "hydra.run.dir=run"]
    assert train(*run) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert line.startswith("error: ") and said in line
    assert not Path("run").exists()


def test_a_run_keeps_its_name_at_weights_and_biases(tmp_path: Path) -> None:
    first, other = tmp_path / "a", tmp_path / "b"
    for folder in (first, other):
        folder.mkdir()
    assert wandb_id(first) == wandb_id(first) != wandb_id(other)
