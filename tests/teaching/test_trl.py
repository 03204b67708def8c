"""A curriculum of prompts in TRL's trainer, as the registry has it, with a tiny model."""

from __future__ import annotations

import runpy
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

import proposer_rl as prl
from proposer_rl.settings import ArgumentError
from tests.teaching.conftest import LOADERS, Install

pytestmark = pytest.mark.slow

PACKAGES = (
    f"trl==1.16.0 transformers==5.24.0 datasets==5.2.0 tokenizers==0.23.3 pyarrow==26.0.1 "
    f"multiprocess==0.70.19 dill==0.4.1 xxhash==4.1.0 regex==2026.11.19 {LOADERS}"
)
EXAMPLE = Path(__file__).parents[2] / "examples" / "taught_prompts.py"
ROWS, ANSWERS = 10, 2
Settings = dict[str, Any]
NAMES = ("gradient_accumulation_steps", "per_device_train_batch_size", "steps_per_generation")
SETTINGS: dict[str, Settings] = {
    "a generation a step": dict(zip(NAMES[:2], (1, 8), strict=True)),
    "TRL's defaults": dict(zip(NAMES[:2], (4, 4), strict=True)),
    "a generation for four steps": dict(zip(NAMES, (1, 2, 2), strict=True), num_iterations=2),
    "four generations in three steps": dict(zip(NAMES, (4, 2, 3), strict=True)),
}


@pytest.fixture(scope="module")
def taught(install: Install) -> Callable[..., Any]:
    """The class, with which TRL can be imported."""
    sys.path.append(str(install(PACKAGES)))  # last: what is there already stays
    from proposer_rl.teaching.trl import TaughtReward

    return TaughtReward


def make(reward: Any, settings: Settings, folder: Path, stream: bool = False) -> Any:
    """Returns a trainer that evaluates and saves at every step."""
    from datasets import Dataset
    from tokenizers import Tokenizer, models
    from transformers import GPT2Config, GPT2LMHeadModel, PreTrainedTokenizerFast
    from trl import GRPOConfig, GRPOTrainer

    torch.manual_seed(0)
    words = Tokenizer(models.WordLevel({f"{n}": n for n in range(ROWS)}, unk_token="0"))
    tokenizer = PreTrainedTokenizerFast(tokenizer_object=words, pad_token="0", eos_token="1")
    sizes = {"n_positions": 8, "n_embd": 8, "n_layer": 1, "n_head": 1, "vocab_size": ROWS}
    model = GPT2LMHeadModel(GPT2Config(**sizes, eos_token_id=1, pad_token_id=0))
    quiet = {"use_cpu": True, "bf16": False, "report_to": [], "disable_tqdm": True}
    groups = {"num_generations": ANSWERS, "max_completion_length": 1, "max_steps": 1, **settings}
    often = {"save_steps": 1, "eval_strategy": "steps", "eval_steps": 1, "logging_steps": 1}
    config = GRPOConfig(str(folder), **groups, **quiet, **often, per_device_eval_batch_size=4)
    parities = ("even", "odd")
    rows = Dataset.from_list(
        [{"prompt": f"{row}", "row": row, "parity": parities[row % 2]} for row in range(ROWS)]
    )
    given = rows.to_iterable_dataset() if stream else rows
    return GRPOTrainer(
        model, reward, config, given, rows.select([0, 1]), processing_class=tokenizer
    )


def train(trainer: Any, steps: int, resume_at: int = 0) -> None:
    trainer.args.max_steps = steps
    folder = f"{trainer.args.output_dir}/checkpoint-{resume_at}"
    trainer.train(resume_from_checkpoint=folder if resume_at else None)


def trained(
    taught: Any, settings: Settings, folder: Path, steps: int, resume_at: int = 0
) -> tuple[list[list[int]], prl.TeacherSampler]:
    """The items of each generation, and the sampler; every third item is solved at times."""
    recipe = prl.curricula.plr(score="learnability", capacity=8, temperature=0.1)
    size = settings["per_device_train_batch_size"] // ANSWERS
    teacher = prl.Teacher(recipe, prl.Items(ROWS), block=size)
    seen: list[list[int]] = []

    def solved(completions: list[str], row: list[int], **_: Any) -> list[float | None]:
        if trainer.model.training:
            seen.append(row)
        return [float(i % 2) if item % 3 == 0 else 0.0 for i, item in enumerate(row)]

    reward = taught(teacher, solved)
    trainer = make(reward, settings, folder)
    reward.attach(trainer)
    train(trainer, steps, resume_at)
    return seen, reward._sampler


@pytest.mark.parametrize("which", SETTINGS)
def test_generations_are_told_and_go_on_bit_by_bit(taught: Any, which: str, tmp_path: Path) -> None:
    """From each of its checkpoints the rest of the run is the same."""
    settings, steps = SETTINGS[which], 4
    whole, sampler = trained(taught, settings, tmp_path, steps)
    for items in whole:  # answers to one prompt stand together
        assert items[::ANSWERS] == items[1::ANSWERS]
    state = sampler.state_dict()
    assert not state["came"]
    drawn = sampler._asked
    told = sum(map(len, whole)) // ANSWERS
    assert sum(map(len, state["out"].values())) == drawn - told
    per_step = settings["gradient_accumulation_steps"]
    rounds = sampler._rounds
    for at in (1, 3):
        rest, sampler = trained(taught, settings, tmp_path, steps, at)
        first = at * per_step // rounds
        assert rest == whole[first : first + len(rest)]
        assert len(rest) >= len(whole) - first - 1


def test_what_is_not_scored_is_dropped(taught: Any, tmp_path: Path) -> None:
    """So is what an earlier training has drawn ahead; the mean is over the other answers."""
    teacher = prl.Teacher("domain_randomization", prl.Items(ROWS), block=4)
    reward = taught(teacher, lambda completions, row, **_: [None, 1.0] * (len(row) // 2))
    trainer = make(reward, SETTINGS["a generation a step"], tmp_path)
    reward.attach(trainer)
    train(trainer, 2)
    results = teacher._ledger.blocks[0].results
    assert results["success"].tolist() == [1.0] * 4
    assert results["episodes"].tolist() == [1.0] * 4
    for _ in range(3):
        train(trainer, 1)
        assert sum(map(len, reward._sampler.state_dict()["out"].values())) == 4  # a group ahead


def test_what_groups_were_like_is_logged(taught: Any, tmp_path: Path) -> None:
    """Of each generation, against a count of its own and TRL's; evaluation logs nothing."""
    teacher = prl.Teacher("domain_randomization", prl.Items(ROWS), block=4)
    seen: list[list[int]] = []

    def solved(completions: list[str], row: list[int], **_: Any) -> list[float]:
        if trainer.model.training:
            seen.append(row)
        return [float(i % 2 if item < 4 else item < 7) for i, item in enumerate(row)]

    reward = taught(teacher, solved, source="parity")
    trainer = make(reward, SETTINGS["a generation a step"], tmp_path)
    reward.attach(trainer)
    train(trainer, 4)
    logs = [log for log in trainer.state.log_history if "curriculum/yield" in log]
    assert len(seen) == len(logs) == 4
    for log, items in zip(logs, seen, strict=True):
        for of in ("", "/even", "/odd"):
            some = [i for i in items[::2] if of in ("", ("/even", "/odd")[i % 2])]
            if some:
                mixed = sum(i < 4 for i in some) / len(some)
                right = sum(0.5 if i < 4 else i < 7 for i in some) / len(some)
                assert log[f"curriculum/yield{of}"] == pytest.approx(mixed)
                assert log[f"curriculum/no_variance{of}"] == pytest.approx(1 - mixed)
                assert log[f"curriculum/success{of}"] == pytest.approx(right)
        assert log["curriculum/no_variance"] == pytest.approx(log["frac_reward_zero_std"])
        assert log["curriculum/success"] == pytest.approx(log["reward"])
    every = {name for log in trainer.state.log_history for name in log}
    assert "eval_reward" in every
    assert not any(name.startswith("eval_curriculum") for name in every)


REFUSED: dict[str, tuple[dict[str, Any], str]] = {
    "a row too few": (
        {"items": ROWS + 1},
        "^train_dataset: 10 rows, but must be a Dataset with one row for each of the teacher's 11",
    ),
    "a stream": ({"stream": True}, "^train_dataset: a stream, but must be a Dataset with one row"),
    "skipping ignored": ({"ignore_data_skip": True}, "ignore_data_skip=True: must be false"),
    "columns removed": ({"remove_unused_columns": True}, "remove_unused_columns=True: must be"),
    "no such column": ({"source": "family"}, "Column 'family' doesn't exist"),
    "attached before": ({"twice": True}, "duplicated columns but columns .'teacher_item'."),
    "not its reward": ({"other": True}, "reward_funcs: must contain this TaughtReward"),
    "no share": ({"reward": torch.nan}, "success=nan: must be from"),
}


@pytest.mark.parametrize("what", REFUSED)
def test_what_does_not_fit_is_refused_in_one_line(taught: Any, what: str, tmp_path: Path) -> None:
    """By ours where it would be silent, otherwise by datasets', before anything is trained."""
    given, message = REFUSED[what]
    settings = {name: given[name] for name in given if name.endswith(("skip", "columns"))}
    with pytest.raises((ArgumentError, ValueError), match=message):
        teacher = prl.Teacher("domain_randomization", prl.Items(given.get("items", ROWS)))

        def scored(completions: list[str], **_: Any) -> list[float]:
            return [given.get("reward", 1.0)] * len(completions)

        reward = taught(teacher, scored, given.get("source"))
        settings |= SETTINGS["a generation a step"]
        used = scored if "other" in given else reward
        trainer = make(used, settings, tmp_path, given.get("stream", False))
        for _ in range(1 + given.get("twice", False)):
            reward.attach(trainer)
        train(trainer, 1)


def test_the_example_trains(taught: Any) -> None:
    example = runpy.run_path(str(EXAMPLE))
    within, solved = example["main"](prl.curricula.plr(**example["REPLAY"]), steps=3)
    assert 0 <= within <= 1 and 0 <= solved <= 100
