"""Batched environments as tasks: runs, what they resume to, and what is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

from proposer_rl.runs.folder import read_csv
from proposer_rl.streams import Streams
from proposer_rl.tasks.gymnasium.networks import NetworkSettings
from tests.host_reads import NoHostReads
from tests.same_run import assert_same_run
from tests.tasks.batched_envs.toys import STILL, TOY, windy_task
from tests.tasks.gymnasium.toys import GATE

WIND = "+task.parameters.wind={low: 0.0, high: 2.0, bins: 4, target: 0.5}"
WINDY = ["task=batched", f"task.env={TOY}", WIND, *GATE]
COUNT = ["task=batched", f"task.env={STILL}", *GATE]
COUNT += ["+task.parameters.first={values: [0, 2, 4], target: 0}"]


@pytest.mark.usefixtures("own_folder")
@pytest.mark.parametrize(
    "given",
    [
        [*WINDY, "+method=domain_randomization", "task.network.memory=4"],
        [*WINDY, "+method=plr", "solver.ppo.continue_episodes=true", "solver.ppo.horizon=14"],
        pytest.param([*COUNT, "+method=model_transport"], marks=pytest.mark.slow),
    ],
    ids=["memory", "continued", "model"],
)
def test_two_seeds_side_by_side_resume_with_the_same_bytes(given: list[str], train: Any) -> None:
    whole, parts = Path("whole"), Path("parts")
    given = [*given, "seeds=[0,1]"]
    assert train(*given, f"hydra.run.dir={whole}") == 0
    for updates in (2, 4):
        words = [*given, f"schedule.updates={updates}", f"hydra.run.dir={parts}"]
        assert train(*words, "schedule.checkpoint_every=2") == 0
    assert [row["updates"] for row in read_csv(whole / "metrics.csv")][-2:] == [4, 4]
    assert_same_run(whole, parts)


@pytest.mark.parametrize("memory", [None, 4])
def test_an_update_never_waits_for_the_device(memory: int | None) -> None:
    task = windy_task(network=NetworkSettings(hidden=[8], memory=memory))
    task.batched = True
    ppo = task.learner([Streams(0), Streams(1)])
    levels = task.target.sample(8, torch.Generator()).reshape(2, 4)
    ppo.env.set_levels(levels)
    draws = [Streams(seed).generator() for seed in (0, 1)]
    ppo.update(draws)  # constants are made
    with NoHostReads():
        ppo.env.set_levels(levels)
        rollout = ppo.update(draws).rollout
    assert rollout["observation"][..., 1].unique().tolist() == [0.5]


def test_its_title_target_and_levels_are_told() -> None:
    task = windy_task()
    assert task.title == "Windy" and task.about["Target"] == "wind 0.5"
    assert {"wind", "seed"} == set(task.space.sample(3, torch.Generator()).keys())


@pytest.mark.usefixtures("own_folder")
@pytest.mark.parametrize(
    ("word", "said"),
    [
        ("task.env=nowhere.at.All", "env: 'nowhere.at.All' cannot be imported"),
        ("task.env=torch.nn.Linear", "task.env='torch.nn.Linear': must be a subclass of Batched"),
    ],
)
def test_what_is_no_environment_is_refused(
    word: str, said: str, train: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    assert train(*WINDY, "+method=target", word, "hydra.run.dir=run") == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert said in line and not Path("run", "run.json").exists()
