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

    @property
    def column_names(self) -> list[str]:
        return [*super().__getitem__(0)]

    def __getitem__(self, which: Any) -> Any:
        return (
            [row[which] for row in self] if isinstance(which, str) else super().__getitem__(which)
        )

    def add_column(self, name: str, values: list[int]) -> Rows:
        return Rows({**row, name: value} for row, value in zip(self, values, strict=True))


class Loader(DataLoader[Any]):
    """What is used of a loader that accelerate has prepared."""

    def set_sampler(self, sampler: Any) -> None:
        self.batch_sampler.sampler = sampler  # type: ignore[union-attr]


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
        self.reward_funcs, self.logged = [reward], dict[str, list[float]]()
        self.train_dataset = Rows({"prompt": f"{row}", "row": row} for row in range(ROWS))
        self.callbacks: list[Any] = []
        self.add_callback = self.callbacks.append

    def train(self, steps: int, resume_at: int = 0) -> None:
        args, loader = self.args, self.get_train_dataloader()
        per_step = args.gradient_accumulation_steps
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

    def get_train_dataloader(self) -> Any:
        return Loader(self.train_dataset, self.args.generation_batch_size, collate_fn=list)  # type: ignore[arg-type]

    def generate(self, batch: list[dict[str, Any]]) -> None:
        columns: dict[str, Any] = {name: [row[name] for row in batch] for name in batch[0]}
        self.reward(completions=[""] * len(batch), **columns, log_metric=self.log_metric)

    def log_metric(self, name: str, value: float) -> None:
        self.logged.setdefault(name, []).append(value)


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
    often = {"save_steps": 1, "eval_strategy": "steps", "eval_steps": 1, "logging_steps": 1}
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


def test_what_groups_were_like_is_logged(taught: Any, tmp_path: Path) -> None:
    """Of each generation, against a count of its own; evaluation logs nothing."""
    teacher = prl.Teacher("domain_randomization", prl.Items(ROWS), block=4)
    seen: list[list[int]] = []

    def solved(completions: list[str], row: list[int], **_: Any) -> list[float]:
        seen.append(row)
        return [float(i % 2 if item < 4 else item < 7) for i, item in enumerate(row)]

    reward = taught(teacher, solved, source="parity")
    trainer = Trainer(reward, SETTINGS["a generation a step"], tmp_path)
    parities = ["odd" if row % 2 else "even" for row in range(ROWS)]
    trainer.train_dataset = Rows(
        {**row, "parity": one} for row, one in zip(trainer.train_dataset, parities, strict=True)
    )
    reward.attach(trainer)
    trainer.train(3)
    trained = seen[::2]  # an evaluation follows each
    assert len(trained) == 3
    for of in ("", "/odd", "/even"):
        groups = [[i for i in one[::2] if of in ("", "/" + parities[i])] for one in trained]
        mixed = [sum(i < 4 for i in some) / len(some) for some in groups if some]
        right = [sum(0.5 if i < 4 else i < 7 for i in some) / len(some) for some in groups if some]
        assert trainer.logged[f"curriculum/yield{of}"] == mixed
        assert trainer.logged[f"curriculum/no_variance{of}"] == [1 - one for one in mixed]
        assert trainer.logged[f"curriculum/success{of}"] == right
    with pytest.raises(ArgumentError, match="trainer: is another one"):
        reward.attach(trainer)


@pytest.mark.slow
def test_trl_logs_it_as_its_own_metrics(taught: Any, tmp_path: Path) -> None:
    """Groups without variance and mean rewards are what TRL finds of them itself."""
    teacher = prl.Teacher("domain_randomization", prl.Items(ROWS), block=4)
    reward = taught(
        teacher, lambda completions, row, **_: [i % 2 if n < 5 else 1.0 for i, n in enumerate(row)]
    )
    trainer = real(reward, SETTINGS["a generation a step"], tmp_path)
    reward.attach(trainer)
    trainer.train(4)
    logs = [log for log in trainer.state.log_history if "curriculum/yield" in log]
    assert len(logs) == 4
    for log in logs:
        assert log["curriculum/no_variance"] == pytest.approx(log["frac_reward_zero_std"])
        assert log["curriculum/success"] == pytest.approx(log["reward"])
    every = {name for log in trainer.state.log_history for name in log}
    assert "eval_reward" in every
    assert not any(name.startswith("eval_curriculum") for name in every)


async def awaited(**_: Any) -> list[float]:
    return [1.0]


REFUSED: dict[str, tuple[dict[str, Any], str]] = {
    "a row too few": ({"items": ROWS + 1}, "train_dataset: has 10 rows, the teacher 11 items"),
    "a stream": ({"train_dataset": iter([])}, "train_dataset: has a stream of rows"),
    "skipping ignored": ({"ignore_data_skip": True}, "ignore_data_skip=True: must be false"),
    "columns removed": ({"remove_unused_columns": True}, "remove_unused_columns=True: must be"),
    "a coroutine": ({"reward": awaited}, "reward: must be a function, no coroutine"),
    "a model's name": ({"reward": "org/model"}, "reward: must be a function, no coroutine"),
    "not attached": ({"attach": False}, "trainer: missing: call attach"),
    "no checkpoint": ({"resume_at": 3}, "resume_from_checkpoint=.*checkpoint-3: has no teacher.pt"),
    "no such column": (
        {"source": "family"},
        "source=family: is no column of train_dataset: prompt, row$",
    ),
    "two of them": ({"rows_of": "teacher_item"}, "train_dataset: has a column teacher_item"),
    "not its reward": ({"reward_funcs": []}, "reward_funcs: must have this TaughtReward"),
    "no share": ({"reward": lambda row, **_: [torch.nan] * len(row)}, "success=nan: must be from"),
    "no items": ({"space": prl.Parameters({"gravity": (5.0, 25.0)})}, "a space of Items"),
}


@pytest.mark.parametrize("what", REFUSED)
def test_what_does_not_fit_is_refused_in_one_line(taught: Any, what: str, tmp_path: Path) -> None:
    given, message = REFUSED[what]
    with pytest.raises(ArgumentError, match=message):
        space = given.get("space") or prl.Items(given.get("items", ROWS))
        teacher = prl.Teacher("domain_randomization", space)
        function = given.get("reward", lambda row, **_: [1.0] * len(row))
        reward = taught(teacher, function, given.get("source"))
        trainer = Trainer(reward, SETTINGS["a generation a step"], tmp_path)
        trainer.train_dataset = given.get("train_dataset", trainer.train_dataset)
        trainer.reward_funcs = given.get("reward_funcs", trainer.reward_funcs)
        if "rows_of" in given:
            trainer.train_dataset = trainer.train_dataset.add_column(given["rows_of"], [0] * ROWS)
        vars(trainer.args).update(
            {name: given[name] for name in given if hasattr(trainer.args, name)}
        )
        if given.get("attach", True):
            reward.attach(trainer)
            trainer.train(1, given.get("resume_at", 0))
        trainer.generate([{"prompt": "0", "row": 0}])
