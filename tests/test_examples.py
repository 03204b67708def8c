"""The examples run as they are, and do what they say."""

from __future__ import annotations

import importlib
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType

import gymnasium
import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs.utils import check_env_specs

from proposer_rl.curricula import TaskStudent, outcome_of
from proposer_rl.meta.rewards import TrainingStep
from proposer_rl.runs.folder import read_csv
from proposer_rl.streams import Streams
from proposer_rl.tasks.mazes import Level
from tests.commands import SMOKE

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


def failures(probability: float, example: Load) -> tuple[Level, Tensor, Level]:
    """Levels, which of them were failed on, and what is proposed next."""
    task = example("small_mazes").small_task()
    solver = task.learner([Streams(0, "solver")])
    make = example("own_curriculum").Again
    curriculum = make(task.target, probability=probability)
    student = TaskStudent(task, solver)
    batch = curriculum.propose(student, 32, [Streams(0)])
    levels = batch.levels
    solver.env.set_levels(levels)
    update = solver.update([torch.Generator().manual_seed(0)])
    curriculum.observe(student, batch, outcome_of(update.rollout))
    resumed = make(task.target, probability=probability)
    resumed.load_state_dict(curriculum.state_dict())
    following = [c.propose(student, 32, [Streams(1)]).levels for c in (curriculum, resumed)]
    assert (following[0] == following[1]).all()
    ends = update.rollout["next"]
    first = ends["done"].squeeze(-1).int().argmax(-1, keepdim=True)  # the first end's step
    solved = ends["terminated"].squeeze(-1).gather(-1, first).squeeze(-1)
    return levels, ~solved, following[0]


@pytest.mark.parametrize("probability", [0.0, 1.0])
def test_failed_levels_come_again(probability: float, example: Load) -> None:
    levels, failed, following = failures(probability, example)
    same = (levels.walls == following.walls).all(-1).all(-1)
    assert failed.any() and not failed.all()
    assert torch.equal(same, failed if probability else torch.zeros_like(failed))


@pytest.mark.parametrize("name", ["own_reward", "own_curriculum"])
def test_a_solver_is_trained_with_it(
    name: str, example: Load, capsys: pytest.CaptureFixture[str]
) -> None:
    example(name).main(1)
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


def test_each_loop_is_short() -> None:
    for file in EXAMPLES.glob("taught_*.py"):
        assert len(file.read_text(encoding="utf-8").splitlines()) <= 60, file.name
