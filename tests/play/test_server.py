"""The page's server: what it answers, and what it refuses of those who should not ask."""

from __future__ import annotations

import json
import re
import shutil
import socket
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from pathlib import Path
from typing import Any

import httpx
import pytest
import torch

from proposer_rl.cli.build import make_task, stored_run
from proposer_rl.cli.config import saved_config
from proposer_rl.cli.eval import evaluate, load
from proposer_rl.play.server import STATIC
from proposer_rl.runs.folder import read_jsonl
from proposer_rl.streams import Streams
from proposer_rl.tasks.mazes.drawings import SETS, levels_to_text, read_levels
from tests.play.pages import Page, served

ROWS = ["S....", ".##..", "....G", ".....", "#...."]
# One for all: each would read the certificates of the machine anew.
CLIENT = httpx.Client(timeout=200, trust_env=False)
JSON = {"Content-Type": "application/json"}
EXAMINE = {"checkpoint": 3, "solver": 0, "rows": ROWS}


def post(page: Page, name: str, question: Any, **headers: str) -> httpx.Response:
    body = question if isinstance(question, bytes) else json.dumps(question).encode()
    return CLIENT.post(f"{page.address}api/{name}", content=body, headers={**JSON, **headers})


def asked(page: Page, name: str, question: Any) -> Any:
    answer = post(page, name, question)
    assert answer.status_code == 200, answer.text
    return answer.json()


def refused(answer: httpx.Response, status: int = 400) -> str:
    """The line with which something was refused."""
    assert answer.status_code == status, answer.text
    (line,) = answer.json()["error"].splitlines()
    assert len(line) < 300
    return line


def raw(page: Page, text: str) -> tuple[int, str]:
    """Status and the rest of the answer to exactly these bytes."""
    with socket.create_connection(("127.0.0.1", page.port)) as connection:
        connection.sendall(text.encode())
        answer = b""
        while chunk := connection.recv(65536):
            answer += chunk
    return int(answer.split()[1]), answer.decode(errors="replace")


@pytest.fixture
def alive(page: Page) -> Iterator[None]:
    """Whatever was done, the next one is answered."""
    yield
    assert CLIENT.get(f"{page.address}api/run").status_code == 200


# What it answers.


def test_the_page_is_there_with_all_that_it_loads(page: Page) -> None:
    answer = CLIENT.get(page.address)
    assert answer.status_code == 200 and answer.headers["content-type"].startswith("text/html")
    loaded = set(re.findall(r'(?:src|href)="([^":]+)"', answer.text))
    for script in STATIC.glob("*.js"):
        imported = re.findall(r'from "\./([^"]+)"', script.read_text(encoding="utf-8"))
        loaded.update(imported)
    assert loaded == {file.name for file in STATIC.iterdir()} - {"play.html"}
    for name in loaded:
        file = CLIENT.get(page.address + name)
        assert file.status_code == 200 and file.content == (STATIC / name).read_bytes()
    assert CLIENT.get(page.address.rstrip("/"), follow_redirects=True).text == answer.text


def test_browsers_are_told_to_load_nothing_else(page: Page) -> None:
    for address in (page.address, f"{page.address}play.js", f"{page.address}api/run"):
        headers = CLIENT.get(address).headers
        policy = dict(part.split(" ", 1) for part in headers["content-security-policy"].split("; "))
        assert policy["default-src"] == "'none'" and policy["script-src"] == "'self'"
        assert "unsafe" not in headers["content-security-policy"]
        assert policy["frame-ancestors"] == "'none'"
        assert headers["x-content-type-options"] == "nosniff"
        assert headers["referrer-policy"] == "no-referrer"  # the address holds the token
        assert "access-control-allow-origin" not in headers and "server" not in headers
    html = (STATIC / "play.html").read_text(encoding="utf-8")
    assert not re.search(r"<script(?![^>]*src=)|<style|\son\w+=|\sstyle=|https?://", html)


def test_the_run_is_told(page: Page) -> None:
    told = CLIENT.get(f"{page.address}api/run").json()
    assert told["title"] == "target_seed_3-5" and told["task_title"] == "5×5 mazes"
    assert told["checkpoints"] == [1, 2, 3] and told["seeds"] == [3, 5]
    assert {"id", "ood"} <= set(told["distributions"])
    assert [(row["updates"], row["seed"]) for row in told["curriculum"]] == [
        (updates, seed) for updates in (2, 4, 6) for seed in (3, 5)
    ]
    assert told["board"]["size"] == [5, 5] and told["board"]["sets"] == ["shapes", "small"]


@pytest.mark.parametrize("solver", [0, 1])
def test_every_checkpoint_is_examined_as_the_command_does(
    page: Page, tmp_path: Path, solver: int
) -> None:
    level = make_task(saved_config(page.run)).board.read(ROWS)
    (tmp_path / "drawn.txt").write_text(levels_to_text({"drawn": level}))
    successes = set()
    for number, file in enumerate(stored_run(page.run).files, 1):
        told = asked(page, "examine", {**EXAMINE, "checkpoint": number, "solver": solver})
        found = evaluate(load(file), str(tmp_path / "drawn.txt"))
        assert told["updates"] == found.updates == 2 * number
        results = found.results[solver].results
        for name in ("success", "return"):
            assert told["results"][name] == pytest.approx(results[name], abs=1e-5)
        successes.add(told["results"]["success"])
    assert len(successes) == 3


def test_a_solver_with_memory_is_examined_as_the_command_does(
    view_page: Page, tmp_path: Path
) -> None:
    rows = ["v....", ".##..", "..#.G", ".....", "#...."]
    (tmp_path / "drawn.txt").write_text("\n".join(rows) + "\n")
    for number, file in enumerate(stored_run(view_page.run).files, 1):
        question = {"checkpoint": number, "solver": 0, "rows": rows}
        told = asked(view_page, "examine", question)
        assert told == asked(view_page, "examine", question)
        (score,) = evaluate(load(file), str(tmp_path / "drawn.txt")).results
        for name in ("success", "return"):
            assert told["results"][name] == pytest.approx(score.results[name], abs=1e-5)
        paths = told["paths"]
        assert len(paths["shortest"]) - 1 == score.about["fewest_actions"]
        assert "policy" not in told and told["maps"] == {}
        # Every way is one that actions lead along, to the goal or as far as there are steps.
        for way in (paths["solver"], paths["shortest"], *paths["sampled"]):
            assert way[0] == [0, 0, 1]
            places = [4 * (5 * row + column) + direction for row, column, direction in way]
            for one, other in pairwise(places):
                assert other in {leads[one] for leads in told["next"]}
            assert way[-1][:2] == [2, 4] or len(way) - 1 == told["max_steps"]
            assert [2, 4] not in [place[:2] for place in way[:-1]]
        assert len(paths["sampled"]) == told["episodes"] == 5
        reached = [way[-1][:2] == [2, 4] for way in paths["sampled"]]
        assert sum(reached) == pytest.approx(5 * told["results"]["success"])


def test_draws_are_a_seeds_own_and_as_good_as_is_told(page: Page) -> None:
    question = {"source": "distribution", "name": "id", "seed": 4, "checkpoint": 2, "solver": 1}
    drawn = asked(page, "levels", question)
    assert drawn == asked(page, "levels", question) and drawn["updates"] == 4
    assert drawn["levels"] != asked(page, "levels", {**question, "seed": 5})["levels"]
    later = asked(page, "levels", {**question, "checkpoint": 3})
    for level, same in zip(drawn["levels"], later["levels"], strict=True):
        assert level["rows"] == same["rows"]
        told = asked(page, "examine", {"checkpoint": 2, "solver": 1, "rows": level["rows"]})
        for name in ("success", "return"):
            assert level["results"][name] == pytest.approx(told["results"][name], abs=1e-5)


def test_sets_files_and_what_was_trained_on(page: Page) -> None:
    shapes = read_levels(SETS["shapes"])
    found = asked(page, "levels", {"source": "set", "name": "shapes"})["levels"]
    assert {one["name"]: "\n".join(one["rows"]) for one in found} == {
        name: level.to_text() for name, level in shapes.items()
    }
    text = levels_to_text(dict(list(shapes.items())[2:4]))
    assert asked(page, "levels", {"source": "file", "text": text})["levels"] == found[2:4]
    recorded = read_jsonl(page.run / "curriculum.jsonl")
    for row, sample in enumerate(recorded):
        of_run = asked(page, "levels", {"source": "curriculum", "row": row})
        assert of_run["updates"] == sample["updates"]
        levels: Any = sample["levels"]
        assert [one["picture"] for one in of_run["levels"]] == [one["picture"] for one in levels]
        for one, level in zip(of_run["levels"], levels, strict=True):
            text = "\n".join(one["rows"]).replace(".", "")
            assert text == "\n".join(level["text"]).replace(" ", "").replace("•", "").replace(
                ".", ""
            )


def test_cars_are_looked_at_though_they_cannot_be_drawn(car_page: Page) -> None:
    told = CLIENT.get(f"{car_page.address}api/run").json()
    assert told["board"] is None and told["task_levels"] == "cars"
    question = {"source": "distribution", "name": "all", "seed": 0, "checkpoint": 2, "solver": 0}
    drawn = asked(car_page, "levels", question)
    stored = stored_run(car_page.run)
    task, agent = stored.task, stored.stage().learner.agent
    streams = Streams(0, "play", "all")
    levels = task.distributions["all"].sample(task.batch_size, streams.generator("levels"))
    with torch.no_grad():
        reached = task.performance(agent, levels, torch.Generator())
    for number, level in enumerate(drawn["levels"]):
        assert level["rows"] is None and level["picture"]
        assert level["text"][0] == f"gravity {levels['gravity'][number]:.4g}"
        expected = reached["return"][0, number].item()
        assert level["results"]["return"] == pytest.approx(expected, abs=1e-6)
    trained_on = asked(car_page, "levels", {"source": "curriculum", "row": 0})["levels"]
    assert trained_on and all(level["picture"] for level in trained_on)
    for name, other in (
        ("examine", {**EXAMINE, "checkpoint": 1}),
        ("file", {"name": "a", "rows": ROWS}),
        ("levels", {"source": "set", "name": "shapes"}),
        ("levels", {"source": "file", "text": "S.G"}),
    ):
        assert refused(post(car_page, name, other)) == "cars cannot be drawn"


def test_checkpoints_come_go_and_break(run: Path, tmp_path: Path) -> None:
    shutil.copytree(run, tmp_path / "run")
    folder = tmp_path / "run" / "checkpoints"
    first, second, _ = sorted(folder.glob("*.pt"))
    first.unlink()
    second.write_bytes(second.read_bytes()[:-5])
    with served(tmp_path / "run") as page:
        assert CLIENT.get(f"{page.address}api/run").json()["checkpoints"] == [2, 3]
        line = refused(post(page, "examine", {**EXAMINE, "checkpoint": 1}))
        assert line == "no checkpoint 1; available: [2, 3]"
        line = refused(post(page, "examine", {**EXAMINE, "checkpoint": 2}))
        assert "is damaged" in line and second.name in line
        assert asked(page, "examine", EXAMINE)["updates"] == 6


# What it refuses.


@pytest.mark.usefixtures("alive")
def test_without_the_token_there_is_nothing(page: Page) -> None:
    root = f"http://127.0.0.1:{page.port}/"
    token = page.address.removeprefix(root).strip("/")
    told = set()
    for given in ("", "play.js", "api/run", f"{token[:-1]}/", f"{token}x/", f"%20{token}/", "é/"):
        for path in (given, f"{given}api/run", f"?token={token}", f"{given}#{token}"):
            answer = CLIENT.get(root + path)
            assert answer.status_code == 403, path
            told.add(answer.text)
    (line,) = told
    assert token not in line
    for method in ("POST", "PUT", "DELETE", "OPTIONS", "HEAD"):
        assert CLIENT.request(method, f"{root}api/examine").status_code == 403


@pytest.mark.usefixtures("alive")
@pytest.mark.parametrize(
    "origin", ["http://evil.example", "null", "http://127.0.0.1", "http://localhost:{port}", "x"]
)
def test_another_page_may_not_ask(page: Page, origin: str) -> None:
    origin = origin.format(port=page.port)
    assert post(page, "examine", EXAMINE, Origin=origin).status_code == 403
    for method in ("GET", "OPTIONS"):
        answer = CLIENT.request(method, f"{page.address}api/run", headers={"Origin": origin})
        assert answer.status_code == 403 and "access-control" not in str(answer.headers).lower()
    own = {"Origin": f"http://127.0.0.1:{page.port}"}
    assert post(page, "examine", EXAMINE, **own).status_code == 200


@pytest.mark.usefixtures("alive")
@pytest.mark.parametrize("host", ["evil.example", "evil.example:{port}", "127.0.0.1.nip.io", ""])
def test_another_host_is_not_this_one(page: Page, host: str) -> None:
    """A name that was made to lead here: DNS rebinding."""
    answer = CLIENT.get(page.address, headers={"Host": host.format(port=page.port)})
    assert answer.status_code == 400 and "<html" not in answer.text
    assert CLIENT.get(page.address, headers={"Host": f"localhost:{page.port}"}).status_code == 200


@pytest.mark.usefixtures("alive")
@pytest.mark.parametrize(
    "path",
    [
        "../../../../etc/passwd",
        "..%2f..%2f..%2fpyproject.toml",
        "static/play.js",
        "//etc/passwd",
        "..\\..\\session.py",
        "play.js%00.html",
        "session.py",
        "checkpoints/step_000000003.pt",
        "api/run/../../config.json",
    ],
)
def test_no_other_file_is_reached(page: Page, path: str) -> None:
    token = page.address.rsplit("/", 2)[1]
    host = f"Host: 127.0.0.1:{page.port}\r\nConnection: close\r\n"
    status, answer = raw(page, f"GET /{token}/{path} HTTP/1.1\r\n{host}\r\n")
    assert status in (403, 404), answer
    assert "root:" not in answer and "class " not in answer and '"method"' not in answer


SAMPLE = {"source": "distribution", "name": "id", "seed": 0, "checkpoint": 3, "solver": 0}
WRONG = [
    ("examine", b"", "EOF"),
    ("examine", {**EXAMINE, "checkpoint": "3"}, "checkpoint: Input should be a valid integer"),
    ("examine", {**EXAMINE, "checkpoint": 9}, "no checkpoint 9; available: [1, 2, 3]"),
    ("examine", {**EXAMINE, "rows": ["....."] * 5}, "one 'S' and one 'G'"),
    ("examine", {**EXAMINE, "rows": ["<b>" * 3] * 5}, "a level is a rectangle of"),
    ("examine", {**EXAMINE, "rows": ["S.G"]}, "too few for this Solver"),
    ("levels", {**SAMPLE, "name": "../x"}, "../x"),
    ("levels", {"source": "set", "name": "../level_files"}, "'../level_files'"),
    ("levels", {"source": "file", "text": "/etc/passwd"}, "a level is a rectangle of"),
]


@pytest.mark.usefixtures("alive")
@pytest.mark.parametrize(("name", "question", "message"), WRONG)
def test_malformed_questions_get_a_line(page: Page, name: str, question: Any, message: str) -> None:
    assert message in refused(post(page, name, question))


@pytest.mark.usefixtures("alive")
def test_forms_and_other_methods_are_refused(page: Page) -> None:
    """What a browser sends for another page without asking first."""
    for kind in ("text/plain", "application/x-www-form-urlencoded", "multipart/form-data", ""):
        refused(post(page, "examine", EXAMINE, **{"Content-Type": kind}), 415)
    for method in ("GET", "PUT", "PATCH", "DELETE"):
        assert CLIENT.request(method, f"{page.address}api/examine").status_code == 405
    assert CLIENT.post(f"{page.address}api/run", json={}).status_code == 405


@pytest.mark.usefixtures("alive")
def test_twenty_at_once_get_what_each_would_get_alone(page: Page) -> None:
    names = [("examine", {**EXAMINE, "checkpoint": 1 + i % 3, "solver": i % 2}) for i in range(6)]
    names += [("levels", {**SAMPLE, "seed": i}) for i in range(2)]
    names += [("levels", {"source": "set", "name": "shapes"}), ("examine", {})]
    alone = [post(page, *question) for question in names]
    with ThreadPoolExecutor(20) as pool:
        together = list(pool.map(lambda i: post(page, *names[i % 10]), range(20)))
    for number, answer in enumerate(together):
        assert answer.status_code == alone[number % 10].status_code
        assert answer.json() == alone[number % 10].json()
