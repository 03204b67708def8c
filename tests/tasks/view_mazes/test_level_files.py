"""Files of levels: drawings, modules such as jaxued's, MiniGrid's encodings, and what is none."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from minigrid.core.constants import COLOR_TO_IDX, OBJECT_TO_IDX

from proposer_rl.tasks.mazes.level_files import shipped_levels
from proposer_rl.tasks.mazes.rendering import level_records
from proposer_rl.tasks.view_mazes.view_levels import ViewLevel, read_view_levels
from research.benchmarks.minigrid_env import MiniGridMaze
from tests.tasks.view_mazes.oracles import random_levels

# A module as jaxued's is written, with levels of our own.
MODULE = '''
import jax.numpy as jnp

class Level:
    """A docstring with > and G in it."""

VERSION = ">G is not a level"
Hall = """
>..
..G
"""
Corner = """
.#v
..G
""".strip()
Bend = """
.#v
..G
"""
prefabs = {"Hall": Hall.strip()}
'''


def encoded(level: ViewLevel) -> np.ndarray:
    """As FullyObsWrapper shows MiniGrid's grid: with the agent, and with the border."""
    env = MiniGridMaze(level, 10)
    env.reset()
    full = env.grid.encode()
    column, row = env.agent_pos
    full[column, row] = [OBJECT_TO_IDX["agent"], COLOR_TO_IDX["red"], env.agent_dir]
    return full


def test_drawings_may_have_directions(tmp_path: Path) -> None:
    file = tmp_path / "mine.txt"
    file.write_text("[one]\n>..\n..G\n\n[two]\npath_length: 1\n^G\n\n[three]\nSG\n")
    levels = read_view_levels(file)
    assert [int(level.direction) for level in levels.values()] == [0, 3, 0]
    assert levels["one"].to_text() == ">..\n..G"
    single = tmp_path / "single.txt"
    single.write_text("\n..<\nG..\n")
    assert read_view_levels(single)["single"].to_text() == "..<\nG.."
    table = tmp_path / "mine.json"
    table.write_text(json.dumps({"levels": [{"name": "a", "level": ["v.", ".G"]}]}))
    assert read_view_levels(table)["a"].to_text() == "v.\n.G"


def test_levels_that_a_run_trained_on_keep_their_directions(tmp_path: Path) -> None:
    drawings = ["v.#\n#.G", "..^\nG.#"]
    records = [{"text": r["text"]} for r in level_records(ViewLevel.from_text(drawings), None)]
    file = tmp_path / "curriculum.jsonl"
    file.write_text(json.dumps({"updates": 5, "seed": 0, "levels": records}) + "\n")
    levels = read_view_levels(file)
    assert list(levels) == ["update_00005_1", "update_00005_2"]
    assert [level.to_text() for level in levels.values()] == drawings


def test_names_with_a_type_count_too(tmp_path: Path) -> None:
    (tmp_path / "a.py").write_text('room: str = """\n>.\n.G\n"""\nhall = ">.G"\nside: int\n')
    assert list(read_view_levels(tmp_path / "a.py")) == ["room", "hall"]


def test_a_module_is_read_and_not_run(tmp_path: Path) -> None:
    file = tmp_path / "level.py"
    file.write_text(MODULE + "\nraise SystemExit('executed')\n")
    levels = read_view_levels(file)
    assert {name: level.to_text() for name, level in levels.items()} == {
        "Hall": ">..\n..G",
        "Bend": ".#v\n..G",
    }


@pytest.mark.parametrize("form", ["npy", "json"])
def test_minigrids_encodings_are_read(tmp_path: Path, form: str) -> None:
    drawn = []
    for level in random_levels(12, side=6):
        file = tmp_path / f"one.{form}"
        if form == "npy":
            np.save(file, encoded(level))
        else:
            file.write_text(json.dumps(encoded(level).tolist()))
        try:
            drawn.append(read_view_levels(file)["one"].to_text() == level.to_text())
        except ValueError as error:
            assert "cannot be reached" in str(error)
    assert all(drawn) and len(drawn) > 6


def test_several_grids_of_one_size(tmp_path: Path) -> None:
    levels = ViewLevel.from_text([">.G\n...", "..^\n#.G"])
    file = tmp_path / "both.npy"
    np.save(file, np.stack([encoded(level) for level in levels]))
    found = read_view_levels(file)
    assert list(found) == ["both_0", "both_1"]
    assert [level.to_text() for level in found.values()] == levels.to_text()


def test_the_sets_that_come_along_look_right() -> None:
    found, plain = shipped_levels("shapes", ViewLevel), shipped_levels("shapes")
    assert list(found) == list(plain)
    assert all(int(level.direction) == 0 for level in found.values())
    assert all(found[name].walls.equal(plain[name].walls) for name in plain)


LAVA = [[[9, 0, 0], [8, 1, 0]], [[1, 0, 0], [10, 0, 0]]]
NOBODY = [[[1, 0, 0], [8, 1, 0]]]


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("a.txt", b"[x]\n>.G\n>..\n", "level 'x': a level is a rectangle"),
        ("a.txt", b">#G\n", "level 'a': the goal cannot be reached"),
        ("a.py", b"x = (\n", "is no Python module"),
        ("a.py", b"x = 1\n", "holds no levels"),
        ("a.py", b"\xff\xfe", "is no Python module"),
        ("a.json", b"[1, 2", "Expecting"),
        ("a.json", b'[["a"]]', "must be MiniGrid's encoding"),
        ("a.json", json.dumps(LAVA).encode(), "level 'a': object 9 with state 0 is none"),
        ("a.json", json.dumps(NOBODY).encode(), "level 'a': must have one agent (object 10)"),
        ("a.csv", b"", "must end in one of .txt, .json, .jsonl, .py, .npy"),
    ],
)
def test_what_is_no_level_is_refused(tmp_path: Path, name: str, content: bytes, said: str) -> None:
    file = tmp_path / name
    file.write_bytes(content)
    with pytest.raises(ValueError) as caught:
        read_view_levels(file)
    assert str(caught.value).startswith(f"{file}: ") and said in str(caught.value)
    assert "\n" not in str(caught.value)


def test_pickles_are_not_loaded(tmp_path: Path) -> None:
    file = tmp_path / "a.npy"
    np.save(file, np.array([{"object": 1}]), allow_pickle=True)
    with pytest.raises(ValueError, match="allow_pickle"):
        read_view_levels(file)
