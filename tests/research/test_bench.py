"""The benchmarks at tiny sizes: that they run and say what they measured, not how fast."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from proposer_rl.report.publish import publish
from proposer_rl.streams import Streams
from proposer_rl.tasks.mazes import MazeEnv, generate_levels
from research.benchmarks import worker
from research.benchmarks.__main__ import main
from research.benchmarks.ceiling import convolutions
from research.benchmarks.environment import bare_dynamics, draw_actions, through_torchrl
from research.benchmarks.gymnasium import Trained, read_rows, write_rows
from research.benchmarks.memory import peak_memory
from research.benchmarks.plain import PlainPPO, PlainUNet
from research.benchmarks.plain_env import PlainMaze
from research.benchmarks.registry import BENCHMARKS, measure
from research.benchmarks.report import summary
from research.benchmarks.results import Options, Result, Row, Spread
from research.benchmarks.scales import PAPER, QUICK, TINY, Solvers
from research.benchmarks.timing import interleave, ratio, threads
from research.timing import read_timing
from tests.commands import call

TRIED = Options(repeats=1, precision="fp32", size="tiny")


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    """Call the command in a folder of its own; returns its exit code."""
    monkeypatch.chdir(tmp_path)
    return partial(call, main)


@pytest.mark.slow
@pytest.mark.parametrize("name", BENCHMARKS)
def test_every_benchmark_measures_something(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    # Real workers are started in tests/meta/workers; here the replicas stay in this process.
    monkeypatch.setattr("research.benchmarks.placement._workers", lambda *_: [])
    result = measure(name, TRIED)
    for row in result.rows:
        assert row.what and row.against
        assert row.target is None and row.reached is None  # nothing is claimed at this size
        assert row.value.low <= row.value.median <= row.value.high
        assert math.isfinite(row.value.median)
    assert result.rows or result.notes
    again = Result.from_json(json.loads(json.dumps(result.to_json())))
    assert again == result


def absent(_: Options) -> Result:
    raise KeyError("nothing")


def test_the_command_writes_a_table_and_a_file_also_when_a_benchmark_fails(
    bench, capsys, monkeypatch, tmp_path: Path
) -> None:
    # What a process of its own would do; the test below starts one.
    def here(command: list[str], **_: Any) -> subprocess.CompletedProcess[str]:
        monkeypatch.setattr(sys, "argv", command[2:])
        worker.main()
        return subprocess.CompletedProcess(command, 0)

    monkeypatch.setattr(worker.subprocess, "run", here)
    monkeypatch.setattr(
        "research.benchmarks.command.selected", lambda *_: ["absent", "shortest_paths"]
    )
    monkeypatch.setitem(BENCHMARKS, "absent", BENCHMARKS["levels"]._replace(run=absent))
    arguments = ["--tiny", "--repeats", "1", "--threads", "1", "--precision", "fp32"]
    assert bench(*arguments, "--output", "b.json") == 1
    printed = capsys.readouterr()
    assert "| what" in printed.out and "networkx" in printed.out
    assert "KeyError: 'nothing'" in printed.err and "[2/2] shortest_paths:" in printed.err
    content = json.loads((tmp_path / "b.json").read_text())
    assert list(content["benchmarks"]) == ["absent", "shortest_paths"]
    told = {"repeats": 1, "precision": "fp32", "size": "tiny", "jaxued": None, "runs": []}
    told["device"] = "cuda" if torch.cuda.is_available() else "cpu"
    assert {**content["options"], **told} == content["options"]
    assert content["machine"]["cores"] and content["versions"]["torch"] == torch.__version__
    assert "error" in content["benchmarks"]["absent"]
    measured = content["benchmarks"]["shortest_paths"]
    assert measured["seconds"] > 0 and measured["threads"] == 1
    assert measured["peak_memory"] > 50 * 2**20  # torch alone takes more
    assert Result.from_json(measured["result"]).rows
    assert not list(tmp_path.glob(".*"))


def test_memory_is_a_process_s_own_and_not_that_of_the_one_which_started_it() -> None:
    read = "from research.benchmarks.memory import peak_memory as p; a = p(); x = b'x' * 2**26; "
    own = [sys.executable, "-c", read + "print(a, p())"]
    before, after = map(int, subprocess.check_output(own, text=True).split())
    assert before < peak_memory() / 3  # which has torch
    assert 0.9 * 2**26 < after - before < 2**27


@pytest.mark.slow
def test_methods_of_runs_are_timed_in_turns(
    bench, train, capsys, monkeypatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("proposer_rl.report.publish.write_page", lambda *_: None)  # its pictures
    for method in ("domain_randomization", "perf_gain"):
        few = ["+scale=smoke", "schedule.updates=1"]
        assert train(f"+method={method}", *few, f"hydra.run.dir=runs/{method}") == 0
    publish([Path("runs")], Path("study"))
    assert bench("curricula", "--runs", "study", "--repeats", "1", "--threads", "1") == 0
    assert "a Solver update of perf_gain, Smoke scale" in capsys.readouterr().out
    timing = read_timing([tmp_path / "bench.json"])
    assert set(timing.seconds) == {"domain_randomization", "perf_gain"}
    assert timing.machine.endswith(", threads: 1")


def test_what_was_trained_before_is_not_trained_again(tmp_path: Path) -> None:
    file = tmp_path / "gymnasium.csv"
    options = Options(size="tiny", seeds=[7, 8], rows=str(file))
    rows = [
        Trained(code, "CartPole-v1", seed, 500, cost, 400.0 + seed, 300.0)
        for code, cost in (("proposer_rl", 2.0), ("stable_baselines3", 4.0))
        for seed in (7, 8)
    ]
    write_rows(file, rows[:3])
    assert file.read_text().splitlines()[:2] == [
        "code,environment,seed,frames,cpu_seconds,mean_return,least_return",
        "proposer_rl,CartPole-v1,7,500,2.0,407.0,300.0",
    ]
    result = measure("gymnasium", options)
    assert read_rows(file)[:3] == rows[:3] and len(read_rows(file)) == 4
    assert result.tables[0].lines[0][:6] == ["CartPole-v1", "proposer_rl", "2", "500", "407.5 ± 0.7", "407.0"]  # fmt: skip  # noqa: E501
    write_rows(file, rows)
    assert measure("gymnasium", options).rows[0].value.median == 0.5


def test_what_is_measured_is_what_a_run_would_be() -> None:
    narrow = QUICK.but("task.network.channels=[16,32,32]", "solver.batch_size=16")
    assert narrow.channels == [16, 32, 32] and narrow.config.solver.batch_size == 16
    assert narrow.threads == 1  # of conf/scale/quick.yaml, but set only while something is timed
    with threads(2):
        made = narrow.made(TRIED, "precision=bf16", "proposer.rollouts=3")
        assert torch.get_num_threads() == 2
    assert made.task.batch_size == 16 and made.task.precision == "bf16"
    assert made.learner.env.batch_size == (1, 16)
    assert made.curricula[0].trainer.env.batch_size == (3,)


def test_the_plain_way_learns_the_same_numbers() -> None:
    """Same rollout, same weights: the reference and the library's PPO end in the same weights."""
    # Coarsest maps of 2x2 and two channels per group: what GroupNorm sees is then not constant,
    # for otherwise gradients are rounding errors, which Adam would blow up.
    scale = TINY.but(
        "task.network={channels: [16,16,16], groups: 8}", "task.maze={height: 8, width: 8}"
    )
    task = scale.task(TRIED)
    solvers = Solvers(task)
    solvers.next_levels()
    solvers.ppo.env.reset()
    network = PlainUNet(scale.channels)
    own = list(solvers.ppo.agent.parameters())
    for plain, parameter in zip(network.parameters(), own, strict=True):
        plain.data.copy_(parameter.data[0])
    start = [parameter.detach().clone() for parameter in own]
    env = MazeEnv(solvers.ppo.env.levels[0], max_steps=task.maze.max_steps)
    reference = PlainPPO(env, network, task.solver.ppo)
    rollout = reference.collect()
    reference.advantages(rollout)
    metrics = solvers.ppo.optimise(rollout.clone().unsqueeze(0))
    epochs = [reference.epoch(rollout) for _ in range(task.solver.ppo.epochs)]
    for part in ("objective", "critic", "entropy"):
        expected = torch.stack([terms[part].detach() for terms in epochs]).mean()
        (found,) = metrics[f"loss_{part}"]
        torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-6)
    for plain, parameter in zip(network.parameters(), own, strict=True):
        torch.testing.assert_close(plain, parameter[0], rtol=1e-3, atol=1e-5)
    assert any(not torch.allclose(p, b, atol=1e-4) for p, b in zip(own, start, strict=True))


def test_three_environments_play_alike() -> None:
    levels = generate_levels(torch.full((16,), 0.2), 3, 6, 6)
    actions = draw_actions(60, 16, "cpu")
    env = MazeEnv(levels, max_steps=25)
    torch.testing.assert_close(through_torchrl(env, actions), bare_dynamics(levels, actions))
    level = levels[0]
    maze = PlainMaze(
        level.walls.numpy(), tuple(level.start.tolist()), tuple(level.goal.tolist()), 25, 0.01
    )
    seen, _ = maze.reset()
    single = MazeEnv(levels[:1], max_steps=25)
    state = single.reset()
    assert np.array_equal(seen["planes"], state["planes"][0].numpy())
    for action in actions[:, 0]:
        seen, reward, terminated, truncated, _ = maze.step(int(action))
        step, state = single.step_and_maybe_reset(state.set("action", action[None]))
        after = step["next"]
        assert seen["agent"].tolist() == after["agent"][0].tolist()
        assert reward == pytest.approx(float(after["reward"]))
        assert (terminated, truncated) == (bool(after["terminated"]), bool(after["truncated"]))
        if terminated or truncated:
            maze.reset()


def test_the_convolutions_are_those_of_the_solver() -> None:
    layers = convolutions([64, 128, 256], 128, 10, 10)
    solver = PAPER.task(TRIED).learner([Streams(0)])
    weights = [p for p in solver.agent.parameters() if p.ndim == 5]
    expected = sorted(tuple(weight.shape[1:4]) for weight in weights)
    assert sorted((c.outputs, c.inputs, c.kernel) for c in layers) == expected
    assert [layer.first for layer in layers].count(True) == 1
    assert sum(c.training_flops for c in layers) * 8 == pytest.approx(0.26e12, rel=0.2)


def test_interleaving_alternates_and_pairs_rounds() -> None:
    called: list[str] = []
    seconds = interleave(
        {name: lambda name=name: called.append(name) for name in "ab"}, repeats=3, warmup=1
    )
    assert "".join(called) == "abababab"
    assert {name: len(times) for name, times in seconds.items()} == {"a": 3, "b": 3}
    assert ratio([1.0, 4.0, 9.0], [1.0, 2.0, 3.0]) == Spread(2.0, 1.0, 3.0)


@pytest.mark.parametrize(
    ("value", "at_most", "reached"), [(1.0, False, "no"), (3.0, False, "yes"), (3.0, True, "no")]
)
def test_a_row_says_whether_its_target_is_reached(value, at_most, reached) -> None:
    row = Row("this", "that", Spread.of([value]), "x", target=2.0, at_most=at_most)
    assert summary([Result([row])]).splitlines()[-1].split("|")[-2].strip() == reached
