"""A curriculum of prompts in TRL's trainer, and in one that stands in for it."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch.utils.data import DataLoader

import proposer_rl as prl
from proposer_rl.settings import ArgumentError

ROWS, ANSWERS = 10, 2
Settings = dict[str, int]
SETTINGS: dict[str, Settings] = {
    "a generation a step": {"gradient_accumulation_steps": 1, "per_device_train_batch_size": 8},
    "TRL's defaults": {"gradient_accumulation_steps": 4, "per_device_train_batch_size": 4},
    "a generation for four steps": {
        "gradient_accumulation_steps": 1,
        "per_device_train_batch_size": 2,
        "steps_per_generation": 2,
        "num_iterations": 2,
    },
    "four generations in three steps": {
        "gradient_accumulation_steps": 4,
        "per_device_train_batch_size": 2,
        "steps_per_generation": 3,
    },
}


@pytest.fixture
def taught(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The class, also where there is no transformers."""
    try:
        import transformers  # noqa: F401
    except ImportError:
        stand_in = SimpleNamespace(TrainerCallback=object)
        monkeypatch.setitem(sys.modules, "transformers", stand_in)
        monkeypatch.delitem(sys.modules, "proposer_rl.teaching.trl", raising=False)
    return importlib.import_module("proposer_rl.teaching.trl").TaughtReward


class Rows(list[dict[str, Any]]):
    """What is used of a data set."""

    def add_column(self, name: str, values: list[int]) -> Rows:
        return Rows({**row, name: value} for row, value in zip(self, values, strict=True))


class Trainer:
    """TRL's order of drawing, generating, evaluating and saving, without a model.

    Batches of a step are drawn together, and one more ahead of them; every ``steps_per_generation *
    num_iterations`` steps there is a generation, counted from where training is resumed.
    """

    saves = (1, 3)

    def __init__(self, reward: Any, settings: Settings, folder: Path) -> None:
        filled = {"steps_per_generation": settings["gradient_accumulation_steps"]}
        filled |= {"num_iterations": 1, "num_generations": ANSWERS} | settings
        size = filled["per_device_train_batch_size"] * filled["steps_per_generation"]
        self.args = SimpleNamespace(
            **filled,
            generation_batch_size=size,
            output_dir=folder,
            should_save=True,
            ignore_data_skip=False,
            remove_unused_columns=False,
        )
        self.reward, self.model = reward, SimpleNamespace(training=True)
        self.train_dataset = Rows({"prompt": f"{row}", "row": row} for row in range(ROWS))
        self.callbacks: list[Any] = []
        self.add_callback = self.callbacks.append

    def train(self, steps: int, resume_at: int = 0) -> None:
        args, sampler = self.args, self._get_train_sampler()
        size, per_step = args.generation_batch_size, args.gradient_accumulation_steps
        loader = DataLoader(self.train_dataset, size, sampler=sampler, collate_fn=list)  # type: ignore[arg-type]
        state, count = SimpleNamespace(global_step=resume_at), 0
        of_epoch = -(-len(loader) // per_step)
        for callback in self.callbacks:
            callback.on_train_begin(args, state, None)
        while state.global_step < steps:
            batches = iter(loader)
            for _ in range(state.global_step % of_epoch * per_step):
                next(batches)
            ahead = next(batches, None)
            while ahead is not None and state.global_step < steps:
                together = []
                while ahead is not None and len(together) < per_step:
                    together.append(ahead)
                    ahead = next(batches, None)
                for batch in together:
                    if count % (args.steps_per_generation * args.num_iterations) == 0:
                        self.generate(batch)
                    count += 1
                state.global_step += 1
                self.model.training = False
                self.generate([{"prompt": "0", "row": 0}] * 4)
                self.model.training = True
                if state.global_step in self.saves:
                    (args.output_dir / f"checkpoint-{state.global_step}").mkdir(exist_ok=True)
                    for callback in self.callbacks:
                        callback.on_save(args, state, None)

    def _get_train_sampler(self) -> Any:
        raise NotImplementedError

    def generate(self, batch: list[dict[str, Any]]) -> None:
        columns = {name: [row[name] for row in batch] for name in batch[0]}
        self.reward(completions=[""] * len(batch), **columns)


def real(reward: Any, settings: Settings, folder: Path) -> Any:
    """A trainer of TRL's with a tiny model, which evaluates and saves at every step."""
    pytest.importorskip("trl")
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
    groups = {"num_generations": ANSWERS, "max_completion_length": 1, **settings}
    often = {"save_steps": 1, "eval_strategy": "steps", "eval_steps": 1, "logging_steps": 1000}
    config = GRPOConfig(str(folder), **groups, **quiet, **often, per_device_eval_batch_size=4)
    rows = Dataset.from_list([{"prompt": f"{row}", "row": row} for row in range(ROWS)])
    made = GRPOTrainer(model, reward, config, rows, rows.select([0, 1]), processing_class=tokenizer)

    def train(steps: int, resume_at: int = 0) -> None:
        made.args.max_steps = steps
        type(made).train(made, f"{folder}/checkpoint-{resume_at}" if resume_at else None)

    made.train = train
    return made


def trained(
    taught: Any, make: Any, settings: Settings, folder: Path, steps: int, resume_at: int = 0
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
    trainer.train(steps, resume_at)
    return seen, reward._sampler


@pytest.mark.parametrize("make", [Trainer, pytest.param(real, marks=pytest.mark.slow)])
@pytest.mark.parametrize("which", SETTINGS)
def test_generations_are_told_and_go_on_bit_by_bit(
    taught: Any, which: str, make: Any, tmp_path: Path
) -> None:
    """From each of its checkpoints the rest of the run is the same."""
    settings, steps = SETTINGS[which], 4
    whole, sampler = trained(taught, make, settings, tmp_path, steps)
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
        rest, sampler = trained(taught, make, settings, tmp_path, steps, at)
        first = at * per_step // rounds
        assert rest == whole[first : first + len(rest)]
        assert len(rest) >= len(whole) - first - 1


def test_what_is_not_scored_is_dropped(taught: Any, tmp_path: Path) -> None:
    """So is what an earlier training has drawn ahead; the mean is over the other answers."""
    teacher = prl.Teacher("domain_randomization", prl.Items(ROWS), block=4)
    reward = taught(teacher, lambda completions, row, **_: [None, 1.0] * (len(row) // 2))
    trainer = Trainer(reward, SETTINGS["a generation a step"], tmp_path)
    reward.attach(trainer)
    trainer.train(2)
    results = teacher._ledger.blocks[0].results
    assert results["success"][0].tolist() == [1.0] * 4
    assert results["episodes"][0].tolist() == [1.0] * 4
    for _ in range(3):
        trainer.train(1)
        assert sum(map(len, reward._sampler.state_dict()["out"].values())) == 4  # a group ahead


async def awaited(**_: Any) -> list[float]:
    return [1.0]


REFUSED: dict[str, tuple[dict[str, Any], str]] = {
    "a row too few": ({"items": ROWS + 1}, "train_dataset: has 10 rows, the teacher 11 items"),
    "a stream": ({"train_dataset": iter([])}, "train_dataset: has a stream of rows"),
    "skipping ignored": ({"ignore_data_skip": True}, "ignore_data_skip=True: must be false"),
    "columns removed": ({"remove_unused_columns": True}, "remove_unused_columns=True: must be"),
    "a coroutine": ({"reward": awaited}, "reward: must be no coroutine"),
    "not attached": ({"attach": False}, "trainer: missing: call attach"),
    "no checkpoint": ({"resume_at": 3}, "resume_from_checkpoint=.*checkpoint-3: has no teacher.pt"),
    "no share": ({"reward": lambda row, **_: [torch.nan] * len(row)}, "success=nan: must be from"),
    "no items": ({"space": prl.Parameters({"gravity": (5.0, 25.0)})}, "a space of Items"),
}


@pytest.mark.parametrize("what", REFUSED)
def test_what_does_not_fit_is_refused_in_one_line(taught: Any, what: str, tmp_path: Path) -> None:
    given, message = REFUSED[what]
    with pytest.raises(ArgumentError, match=message):
        space = given.get("space") or prl.Items(given.get("items", ROWS))
        teacher = prl.Teacher("domain_randomization", space)
        reward = taught(teacher, given.get("reward", lambda row, **_: [1.0] * len(row)))
        trainer = Trainer(reward, SETTINGS["a generation a step"], tmp_path)
        trainer.train_dataset = given.get("train_dataset", trainer.train_dataset)
        vars(trainer.args).update(
            {name: given[name] for name in given if hasattr(trainer.args, name)}
        )
        if given.get("attach", True):
            reward.attach(trainer)
            trainer.train(1, given.get("resume_at", 0))
        trainer.generate([{"prompt": "0", "row": 0}])
