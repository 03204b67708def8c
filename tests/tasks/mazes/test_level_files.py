"""Named levels in files: round trips, what is refused, and the set that comes along."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from proposer_rl.tasks.mazes import Level
from proposer_rl.tasks.mazes import level_files as format_
from proposer_rl.tasks.mazes.level_files import (
    levels_from_json,
    levels_from_text,
    levels_to_json,
    levels_to_text,
    read_levels,
    shipped_levels,
    shipped_sets,
    write_levels,
)
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


def test_a_mark_of_the_encoding_is_no_part_of_a_level(tmp_path: Path) -> None:
    (tmp_path / "bom.txt").write_text("S.G\n", encoding="utf-8-sig")
    assert list(read_levels(tmp_path / "bom.txt")) == ["bom"]


def test_a_drawing_alone_has_the_name_of_its_file(tmp_path: Path) -> None:
    (tmp_path / "hall.txt").write_text("S.G\n")
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
        if path_length(levels[0]) > 0:
            found[name] = levels[0]
    return found


@settings(max_examples=30)
@given(level_sets())
def test_round_trips(levels: dict[str, Level]) -> None:
    if levels:
        assert same(levels_from_text(levels_to_text(levels)), levels)
        assert same(levels_from_json(levels_to_json(levels)), levels)


@pytest.mark.parametrize("name", ["levels.txt", "levels.json"])
def test_files(name: str, tmp_path: Path) -> None:
    levels = levels_from_text(HALLS)
    write_levels(tmp_path / name, levels)
    assert same(read_levels(tmp_path / name), levels)
    assert [file.name for file in tmp_path.iterdir()] == [name]


def test_what_is_written_has_the_path_lengths() -> None:
    levels = levels_from_text(HALLS)
    assert [item["path_length"] for item in json.loads(levels_to_json(levels))["levels"]] == [2, 3]
    assert levels_to_text(levels).count("path_length: ") == 2


OF_TEXT = [
    ("", "holds no levels"),
    ("; nothing", "holds no levels"),
    ("[a]\nS.G\n[a]\nS.G", "level 'a': the name occurs twice"),
    ("[a]\nS.G\n..", "level 'a': a level is a rectangle"),
    ("[a]\nS.x", "level 'a': a level is a rectangle of '#' and '.', with one 'S' and one 'G'"),
    ("[a]\nS..", "level 'a': a level is a rectangle"),
    ("[a]", "level 'a': a level is a rectangle"),
    ("[a]\nS#G", "level 'a': the goal cannot be reached"),
    ("[a]\npath_length: 3\nS.G", "path_length is 3, but the shortest path has 2 moves"),
    ("[]\nS.G", "level '': a name has 1 to 80"),
    ("[a[b]\nS.G", "level 'a[b': a name has 1 to 80 printable characters, no brackets"),
    (f"[{'a' * 81}]\nS.G", "a name has 1 to 80 printable"),
    ("[a\x1bb]\nS.G", "a name has 1 to 80 printable"),
]
OF_JSON = [
    ("{", "Expecting property name"),
    ("[]", 'an object with a list "levels"'),
    ('{"levels": {}}', "levels={}: input should be a valid array"),
    ('{"levels": []}', "holds no levels"),
    ('{"levels": [{"name": "a"}]}', "levels.0.level: missing"),
    ('{"levels": [{"name": 3, "level": ["S.G"]}]}', "levels.0.name=3: input should be a valid"),
    (
        '{"levels": [{"name": "a", "level": ["S.G"], "path_length": true}]}',
        "levels.0.path_length=True: input should be a valid integer",
    ),
    (
        '{"levels": [{"name": "a", "level": ["S.G"], "path_length": 1}]}',
        "path_length is 1, but the shortest path has 2 moves",
    ),
    ('{"levels": [{"name": "a", "level": ["S.G"], "size": 3}]}', "levels.0.size: unknown"),
]
NO_RECORDS = [
    "{",
    "[]",
    "3",
    '{"seed": 0, "levels": []}',
    '{"seed": 0, "updates": "x", "levels": []}',
    '{"seed": 0, "updates": 1, "levels": [{}]}',
    '{"seed": 0, "updates": 1, "levels": [{"text": [3]}]}',
    '{"seed": 0, "updates": 1, "levels": [{"text": ["S x"]}]}',
]
REFUSED = [
    *(("bad.txt", text, message) for text, message in OF_TEXT),
    *(("bad.json", text, message) for text, message in OF_JSON),
    *(
        ("bad.jsonl", f'{{"seed": 0, "updates": 1, "levels": []}}\n{line}\n', "line 2 is no record")
        for line in NO_RECORDS
    ),
    ("bad.jsonl", "", "holds no levels"),
    ("bad.csv", "", "must end in one of .txt, .json, .jsonl"),
    ("bad.txt", b"\xff\xfe", "'utf-8' codec"),
]


@pytest.mark.parametrize(
    ("name", "content", "message"),
    REFUSED,
    ids=[f"{number}-{message}" for number, (*_, message) in enumerate(REFUSED)],
)
def test_what_holds_no_levels_is_refused(
    name: str, content: str | bytes, message: str, tmp_path: Path
) -> None:
    file = tmp_path / name
    file.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(ValueError) as caught:
        read_levels(file)
    assert str(caught.value).startswith(f"{file}: ") and message in str(caught.value)


def test_other_files_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ValueError, match=r"levels.jsonl: must end in one of .txt, .json$"):
        write_levels("levels.jsonl", levels_from_text(HALLS))
    with pytest.raises(OSError, match=r"cannot read .*nothing.txt: No such file"):
        read_levels(tmp_path / "nothing.txt")
    monkeypatch.setattr(format_, "LARGEST_FILE_BYTES", 10)
    (tmp_path / "large.txt").write_text(HALLS)
    with pytest.raises(ValueError, match=r"large.txt: is larger than 10 bytes"):
        read_levels(tmp_path / "large.txt")


def test_levels_that_could_not_be_read_again_are_not_written(tmp_path: Path) -> None:
    hall = Level.from_text("S.G")
    for levels, message in (
        ({"a]": hall}, "a name has"),
        ({" a": hall}, "a name has"),
        ({"a": Level.from_text("S#G")}, "cannot be reached"),
    ):
        with pytest.raises(ValueError, match=message):
            write_levels(tmp_path / "levels.txt", levels)
    assert not list(tmp_path.iterdir())


def test_the_sets_that_come_along() -> None:
    assert shipped_sets() == ["shapes", "small"]
    with pytest.raises(
        ValueError, match=r"nothing: no such set of levels; available: \['shapes', 'small'\]"
    ):
        shipped_levels("nothing")


def test_shapes_are_what_they_are_called() -> None:
    levels = shipped_levels("shapes")
    assert len(levels) >= 15
    for family in ("corridor", "rooms", "spiral", "labyrinth", "comb"):
        assert sum(family in name for name in levels) >= 3, family
    for name, level in levels.items():
        height, width = level.walls.shape
        assert max(height, width) == int(name.rpartition("_")[2])
        assert min(height, width) >= 8 and max(height, width) <= 21
    drawings = {level.to_text() for level in levels.values()}
    assert len(drawings) == len(levels)


def test_small_levels_are_small_and_each_is_another() -> None:
    levels = shipped_levels("small")
    assert len(levels) >= 15 and len({level.to_text() for level in levels.values()}) == len(levels)
    for name, level in levels.items():
        assert tuple(level.walls.shape) == (int(name[-1]),) * 2 and name[-2:] in ("_5", "_6")


@pytest.mark.parametrize("name", shipped_sets())
def test_the_recorded_path_lengths_are_right(name: str) -> None:
    """By networkx; reading them has compared them with our own routine."""
    text = (Path(format_.__file__).parent / f"{name}.txt").read_text()
    recorded = [int(line.split(":")[1]) for line in text.splitlines() if "path_length" in line]
    assert recorded == [path_length(level) for level in shipped_levels(name).values()]


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
