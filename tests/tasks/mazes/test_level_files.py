"""Named levels in files: round trips, what is refused, and the set that comes along."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from proposer_rl.tasks.mazes import Level
from proposer_rl.tasks.mazes.drawings import (
    SETS,
    level_records,
    levels_from_text,
    levels_to_text,
    read_levels,
)
from proposer_rl.tasks.view_mazes.view_levels import ViewLevel
from tests.tasks.mazes.oracles import path_length, random_levels

HALLS = """\
; two halls

[short hall]
S.G
[bent]
path_length: 3
; the corner
S.
#.
#G
"""


def same(some: dict[str, Level], others: dict[str, Level]) -> bool:
    return list(some) == list(others) and all((some[n] == others[n]).all() for n in some)


def test_reads_the_documented_text() -> None:
    levels = levels_from_text(HALLS)
    assert {name: level.to_text() for name, level in levels.items()} == {
        "short hall": "S.G",
        "bent": "S.\n#.\n#G",
    }
    assert all(level.batch_size == torch.Size([]) for level in levels.values())


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig"])
def test_a_drawing_alone_has_the_name_of_its_file(tmp_path: Path, encoding: str) -> None:
    (tmp_path / "hall.txt").write_text("S.G\n", encoding)
    assert list(read_levels(tmp_path / "hall.txt")) == ["hall"]


@st.composite
def level_sets(draw: st.DrawFn) -> dict[str, Level]:
    plain = st.text(
        st.characters(exclude_characters="[]", exclude_categories=["C", "Z"]), min_size=1
    )
    names = draw(
        st.lists(plain.filter(lambda n: len(n) <= 80), min_size=1, max_size=4, unique=True)
    )
    found = {}
    for name in names:
        size = draw(st.tuples(st.integers(1, 7), st.integers(2, 9)))
        levels = random_levels(1, *size, 0.2, draw(st.integers(0, 1000)))
        found[name] = levels[0]
    return found


@settings(max_examples=30)
@given(level_sets())
def test_round_trips(levels: dict[str, Level]) -> None:
    assert same(levels_from_text(levels_to_text(levels)), levels)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("bad.txt", "; nothing", "holds no levels"),
        ("bad.txt", "[a]\nS.G\n[a]\nS.G", "level 'a': the name occurs twice"),
        ("bad.txt", "[a]\nS.G\n..", "level 'a': a level is a rectangle"),
        ("bad.txt", "[a]\npath_length: 3\nS.G", "is 3, but the shortest path has 2 moves"),
        ("bad.jsonl", '{"seed": 0, "levels": []}\n', "0.updates: Field required"),
        ("bad.jsonl", '{"seed": 0, "updates": 1, "levels": [{"text": ["S x"]}]}\n', "rectangle"),
    ],
)
def test_what_holds_no_levels_is_refused(
    name: str, content: str, message: str, tmp_path: Path
) -> None:
    file = tmp_path / name
    file.write_text(content)
    with pytest.raises(ValueError) as caught:
        read_levels(file)
    assert str(caught.value).startswith(f"{file}: ") and message in str(caught.value)


def test_shapes_are_what_they_are_called() -> None:
    levels = read_levels(SETS["shapes"])
    assert len(levels) >= 15
    for family in ("corridor", "rooms", "spiral", "labyrinth", "comb"):
        assert sum(family in name for name in levels) >= 3, family
    for name, level in levels.items():
        height, width = level.walls.shape
        assert max(height, width) == int(name.rpartition("_")[2])
        assert min(height, width) >= 8 and max(height, width) <= 21
    drawings = {level.to_text() for level in levels.values()}
    assert len(drawings) == len(levels)


@pytest.mark.parametrize("name", ["shapes", "small"])
def test_the_recorded_path_lengths_are_right(name: str) -> None:
    """By networkx; reading them has compared them with our own routine."""
    text = SETS[name].read_text()
    recorded = [int(line.split(":")[1]) for line in text.splitlines() if "path_length" in line]
    assert recorded == [path_length(level) for level in read_levels(SETS[name]).values()]


LINES = ["S • #", "# • G"]


def test_the_levels_of_a_run_are_read_from_its_record(tmp_path: Path) -> None:
    rows = [
        {"updates": 10, "seed": 3, "levels": [{"text": LINES, "picture": "x"}] * 2},
        {"updates": 20, "seed": 3, "levels": [{"text": ["S # G"]}]},
    ]
    lines = [json.dumps(row) + "\n" for row in rows]
    (tmp_path / "curriculum.jsonl").write_text("".join([*lines, '{"updates": 30']))
    levels = read_levels(tmp_path / "curriculum.jsonl")
    # The Solver's episode is gone, and a goal that is out of reach stays.
    assert {name: level.to_text() for name, level in levels.items()} == {
        "update_00010_1": "S.#\n#.G",
        "update_00010_2": "S.#\n#.G",
        "update_00020_1": "S#G",
    }
    rows[1]["seed"] = 4
    (tmp_path / "two.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    assert list(read_levels(tmp_path / "two.jsonl"))[1:] == [
        "seed_3_update_00010_2",
        "seed_4_update_00020_1",
    ]


def test_levels_with_directions(tmp_path: Path) -> None:
    """Drawn, in a run's record; where there is none, an agent looks to the right."""
    file, drawings = tmp_path / "mine.txt", ["v.#\n#.G", "..^\nG.#"]
    file.write_text("[one]\n>..\n..G\n\n[two]\npath_length: 1\n^G\n\n[three]\nSG\n")
    levels = read_levels(file, ViewLevel)
    assert [int(level.direction) for level in levels.values()] == [0, 3, 0]
    assert levels["one"].to_text() == ">..\n..G"
    records = [{"text": r["text"]} for r in level_records(ViewLevel.from_text(drawings), None)]
    (tmp_path / "own.jsonl").write_text(
        json.dumps({"updates": 5, "seed": 0, "levels": records}) + "\n"
    )
    again = read_levels(tmp_path / "own.jsonl", ViewLevel)
    assert [level.to_text() for level in again.values()] == drawings
    found, plain = read_levels(SETS["shapes"], ViewLevel), read_levels(SETS["shapes"])
    assert all(int(found[name].direction) == 0 for name in plain)
    assert all(found[name].walls.equal(plain[name].walls) for name in plain)
