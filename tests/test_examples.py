"""The examples run as they are, and do what they say."""

from __future__ import annotations

import importlib
import json
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType

import gymnasium
import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs

import proposer_rl as prl
from proposer_rl.cli.eval import main as evaluate
from proposer_rl.cli.play import open_session
from proposer_rl.cli.report import main as report
from proposer_rl.cli.watch import main as watch
from proposer_rl.meta.rewards import TrainingStep
from proposer_rl.play.session import Drawn, OfCurriculum
from proposer_rl.report.figures import learning_curves
from proposer_rl.runs.folder import read_csv
from proposer_rl.streams import Streams
from tests.commands import SMOKE, trained_run
from tests.curricula.test_contract import same

ROOT = Path(__file__).parents[1]
EXAMPLES = ROOT / "examples"
SHARED = ["small_mazes"]
NAMES = sorted({file.stem for file in EXAMPLES.glob("*.py")} - set(SHARED))

Load = Callable[[str], ModuleType]


@pytest.fixture
def example(monkeypatch: pytest.MonkeyPatch, own_folder: None) -> Iterator[Load]:
    """Imports an example as a script in its folder would be found."""
    monkeypatch.syspath_prepend(str(EXAMPLES))
    yield importlib.import_module


def numbers(text: str, pattern: str) -> list[float]:
    """What the pattern's group matches in a text, in order."""
    return [float(found) for found in re.findall(pattern, text)]


@pytest.mark.parametrize("name", NAMES)
def test_each_says_what_it_shows_and_is_listed(name: str) -> None:
    text = (EXAMPLES / f"{name}.py").read_text(encoding="utf-8")
    docstring = text.split('"""')[1]
    is_task = (EXAMPLES / "conf" / "task" / f"{name}.yaml").exists()
    started = f"task={name}" if is_task else f"python examples/{name}.py"
    assert text.startswith('"""') and started in docstring
    pages = (ROOT / "docs/how_to" / f"{page}.md" for page in ("own_parts", "own_loop"))
    assert any(name in page.read_text(encoding="utf-8") for page in pages)


def test_the_shortest_task_has_every_command(
    example: Load,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    run = trained_run(
        tmp_path / "run",
        *("--config-dir", f"{EXAMPLES}/conf", "task=own_task", "+method=domain_randomization"),
        *("compute.progress=false", "schedule.updates=4", "task.levels=8", "solver.batch_size=4"),
        *("seeds=[0,1]", "solver.ppo.horizon=10"),
    )
    measured = read_csv(run / "metrics.csv")[-1]
    assert {"target_success", "target_return", "all_success"} <= measured.keys()
    trained = read_csv(run / "training.csv")[-1]
    assert 1 <= trained["distance"] <= 9 and 0 <= trained["wind"] <= 1
    watch([str(run), "--once"])
    assert "target success" in capsys.readouterr().out
    evaluate([str(run), "--levels", "all", "-o", str(tmp_path / "rows.json")])
    rows = json.loads((tmp_path / "rows.json").read_text())
    assert len(rows) == 2 * 8 and all(0 <= row["success"] <= 1 for row in rows)
    with pytest.raises(SystemExit):
        evaluate([str(run), "--levels", "here"])
    assert "--levels here: must be one of: target, all" in capsys.readouterr().err
    session = open_session(run)
    assert session.about()["board"] is None and session.about()["task_levels"] == "sledges"
    drawn = Drawn(source="distribution", name="target", seed=3, checkpoint=1, solver=1)
    for shown in (session.levels(drawn), session.levels(OfCurriculum(source="curriculum", row=0))):
        assert all(level["picture"] and "wind" in level["text"][1] for level in shown["levels"])
    monkeypatch.setattr("proposer_rl.report.build.DRAWINGS", [learning_curves])
    report([str(run), "-o", str(tmp_path / "report")])
    assert "Sledges of that batch" in (tmp_path / "report" / "report.html").read_text("utf-8")


def test_the_mountain_car_is_gymnasiums(example: Load) -> None:
    """At gravity 1 and power 1 it takes Gymnasium's steps, five at a time."""
    own = example("mountain_car")
    reference = gymnasium.make("MountainCar-v0").unwrapped
    level = {"gravity": torch.ones(1), "power": torch.ones(1), "start": torch.tensor([-0.5])}
    env = own.MountainCar(TensorDict(level, [1]))
    check_env_specs(env)
    state = env.reset()
    reference.state = np.array([-0.5, 0.0])
    pushes = [0] * 4 + [2] * 6 + [0] * 8 + [1] * 3 + [2] * 12  # from wall to top
    ends = []
    for push in pushes:
        state = env.step(state.set("action", torch.tensor([push])))["next"]
        steps = [reference.step(push) for _ in range(5)]
        ends.append(any(terminated for _, _, terminated, _, _ in steps))
        place, speed = (state["observation"][0] * torch.tensor([0.9, 0.07])).tolist()
        np.testing.assert_allclose([place, speed], reference.state, atol=2e-5)
        assert bool(state["terminated"]) == ends[-1]
        if ends[-1]:
            break
    assert ends[-1] and len(ends) > 20


def test_the_reward_is_learnability_by_hand(example: Load) -> None:
    own = example("own_reward")
    done, terminated = torch.zeros(2, 2, 2, 6, 1, dtype=torch.bool).unbind(0)
    done[0, 0, [1, 3, 5]] = True  # three episodes, one of them solved
    terminated[0, 0, 1] = True
    done[1, 0, [2, 5]] = terminated[1, 0, [2, 5]] = True  # both solved
    done[1, 1, 5] = True  # one, not solved; of [0, 1] none has ended
    rollout = TensorDict({"next": TensorDict({"done": done, "terminated": terminated})})
    step = TrainingStep(None, rollout, None, torch.zeros(2), torch.zeros(2))  # type: ignore[arg-type]
    expected = torch.tensor([(1 / 3 * 2 / 3 + 0) / 2, 0.0])
    torch.testing.assert_close(own.learnability(step), expected)


def test_failed_levels_come_again(example: Load) -> None:
    """In order and out of it, and from a state."""
    again = example("own_curriculum").Again
    space = prl.Parameters({"force": (0.0, 1.0)})
    teacher, resumed = (prl.Teacher(again(space), space, block=32) for _ in range(2))
    ids, levels = teacher.ask(32)
    failed = levels["force"] > 0.5
    order = torch.randperm(32, generator=torch.Generator().manual_seed(0))
    for some in order.split(8):
        teacher.tell(ids[some], 0.0 * some, ~failed[some])
    teacher.drop()
    resumed.load_state_dict(teacher.state_dict())
    following, others = (each.propose(32)["force"] for each in (teacher, resumed))
    assert torch.equal(following, others)
    assert torch.equal(following[: failed.sum()], levels["force"][failed]) and 0 < failed.sum() < 32


def test_a_solver_is_trained_with_it(example: Load, capsys: pytest.CaptureFixture[str]) -> None:
    example("own_reward").main(1)
    assert len(numbers(capsys.readouterr().out, r"success (\S+)")) == 2


def test_learners_of_ones_own_train_in_the_meta_environment(example: Load) -> None:
    own = example("own_learner")
    check_env_specs(own.meta_environment())
    env = own.meta_environment()
    env.fork(env.solvers.snapshot()[0], Streams(0))
    before = env.reset()["return"]
    gains = []
    for number in (0.0, -20.0):  # all classes alike; the first one alone
        env.reset()
        step = env.step(TensorDict({"action": torch.full((4, 1), number)}, [4]))["next"]
        torch.testing.assert_close(step["reward"], step["return"] - before)
        gains.append(float(step["reward"].mean()))
    assert gains[0] > gains[1] + 0.1 > 0.1
    numbers = own.MEANS.new_tensor([1.0, -1.0, -1.0])  # by hand: a step of one learner
    learner = own.SoftmaxRegression(1, 1, rate=0.3)
    point = TensorDict(
        {"point": torch.tensor([[[1.0, 2.0]]]), "label": torch.tensor([[0]])}, [1, 1]
    )
    learner.env.set_levels(point)
    learner.update([])
    error = (numbers + 1) / 2 - 1 / 3
    expected = 0.3 * torch.tensor([1.0, 2.0]).unsqueeze(1) * error
    torch.testing.assert_close(learner.agent[0], expected)


def test_a_proposer_of_ones_own_trains_solvers_that_begin_anew(
    example: Load, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """In the first and in the third cycle; the second goes on from the first replica."""
    own, begun, ended = example("stock_proposer"), [], []
    fork = own.SolverTrainingEnv.fork

    def remembered(env, solver: TensorDict, streams: Streams) -> None:
        begun.append(solver.clone().to_dict())
        ended.append(env.solvers.snapshot()[0].to_dict())  # of the cycle before
        fork(env, solver, streams)

    for name, size in {"UPDATES": 2, "STEPS": 2, "CYCLES_OF_A_SOLVER": 2}.items():
        monkeypatch.setattr(own, name, size)
    monkeypatch.setattr(own.SolverTrainingEnv, "fork", remembered)
    own.main(3)
    _, first, second, third = begun  # the environment's own is the first of all
    assert len(numbers(capsys.readouterr().out, r"return (\S+),")) == 3
    assert same(second, ended[2]) and not same(second, first)
    assert same(third, own.new_solver(own.small_task(), 2).to_dict()) and not same(third, ended[3])


@pytest.mark.slow
def test_the_network_learns_and_acts_in_larger_mazes(
    example: Load, capsys: pytest.CaptureFixture[str]
) -> None:
    example("own_solver").main(30)
    success = numbers(capsys.readouterr().out, r"success (\S+)")
    assert success[0] < 0.2 and success[-2] > 0.5 and success[-1] > 0.5


def test_other_losses_train_the_proposer(
    example: Load, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    own = example("other_loss")
    monkeypatch.setattr(own, "UPDATES", 2)
    own.main(1)
    printed = capsys.readouterr().out
    assert re.findall(r"^(\w+), cycle 0", printed, re.MULTILINE) == ["a2c", "reinforce"]


@pytest.mark.slow
def test_a_stock_script_learns_mazes(
    example: Load, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its collector plays the levels that were set, not a copy of the first ones."""
    stock, played = example("stock_ppo"), []
    collect = stock.Collector.rollout

    def remembered(self) -> TensorDict:
        batch = collect(self)
        played.append(batch["planes"][:, 0].clone())
        return batch

    monkeypatch.setattr(stock.Collector, "rollout", remembered)
    stock.main(16)
    success = numbers(capsys.readouterr().out, r"success (\S+)")
    assert success[0] < 0.25 and success[-1] > success[0] + 0.15
    assert not torch.equal(*played[:2])


@pytest.mark.parametrize("method", sorted(f.stem for f in EXAMPLES.glob("conf/method/*.yaml")))
def test_methods_of_ones_own_run_from_the_command_line(
    method: str, example: Load, train: Callable[..., int]
) -> None:
    given = ["--config-dir", str(EXAMPLES / "conf"), f"+method={method}", *SMOKE]
    assert train(*given, "hydra.run.dir=run") == 0
    rows = read_csv(Path("run/metrics.csv"))
    assert [row["updates"] for row in rows] == [0, 2, 4, 6]


TAUGHT = {"torchrl": 2, "sb3": 512, "single_file": 3, "dqn": 20, "robots": 60, "memory": 22}


@pytest.mark.parametrize("name", TAUGHT)
def test_curricula_in_other_loops_run(
    example: Load, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    loop = example(f"taught_{name}")
    if name == "memory":
        monkeypatch.setattr(loop, "STEPS", 8)  # of an episode, each with a graph of its own
    loop.main(TAUGHT[name])
    assert numbers(capsys.readouterr().out, r"(\d+)")
