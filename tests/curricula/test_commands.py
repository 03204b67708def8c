"""The command and curricula: what it refuses in one line, and what it trains with."""

from __future__ import annotations

import pytest

SMOKE = ("+scale=smoke", "compute.progress=false", "hydra.run.dir=run")


@pytest.mark.usefixtures("own_folder")
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["+method=learning_progress", "curriculum.fast=1"], "curriculum.fast=1: input should be"),
        (["+method=alp_gmm", "curriculum.refit=300"], "warmup=250: a mixture is fitted"),
        (["+method=currot", "curriculum.epsilon=nan"], "curriculum.epsilon=nan: must be finite"),
        (["+method=currot", "compute.collector=multiprocess"], "this method trains no replicas"),
    ],
)
def test_the_command_refuses_in_one_line(
    arguments: list[str], message: str, train, capsys: pytest.CaptureFixture[str]
) -> None:
    capsys.readouterr()  # what was said before is not the command's
    assert train(*arguments, *SMOKE) == 2
    said = capsys.readouterr().err
    errors = [line for line in said.splitlines() if line.startswith("error: ")]
    assert len(errors) == 1 and message in errors[0], said


@pytest.mark.usefixtures("own_folder")
def test_the_command_trains_with_mixtures_that_it_fits(train) -> None:
    small = ["curriculum.warmup=8", "curriculum.refit=8", "curriculum.components=2"]
    assert train("+method=alp_gmm", *SMOKE, *small, "schedule.updates=4") == 0
