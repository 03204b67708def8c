"""A curriculum of prompts in TRL's GRPOTrainer, which learns from the rewards."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import update_wrapper
from pathlib import Path
from typing import Any

import torch
from transformers import TrainerCallback

from proposer_rl.settings import ArgumentError
from proposer_rl.teaching.sampler import TeacherSampler
from proposer_rl.teaching.teacher import Teacher

ROW = "teacher_item"  # the column of the training set that numbers its rows
FILE = "teacher.pt"  # in a checkpoint


class TaughtReward(TrainerCallback):
    """Lets a teacher draw a trainer's prompts, and tells it the rewards of a reward function.

        reward = TaughtReward(teacher, solved)
        trainer = GRPOTrainer(model, reward, config, rows)
        reward.attach(trainer)
        trainer.train()

    Groups and their repetitions follow from the trainer's config; an epoch has as many prompts as
    the training set has rows. Evaluation has no effect. Checkpoints hold the curriculum,
    and ``train(resume_from_checkpoint=...)`` goes on with it. In a launch of several ranks, write
    the same on each. The trainer logs :meth:`TeacherSampler.metrics` as ``curriculum/...``.

    Args:
        teacher: a teacher of :class:`Items`, one for each row of the training set.
        reward: a function of completions and columns, as TRL calls it, but no coroutine, that
            returns how well each completion solves its prompt, from 0 to 1; None for a completion
            that does not count.
        source: the column of the training set by which metrics are also logged; None for none.
    """

    _trainer: Any = None
    _sampler: TeacherSampler
    _loader: Callable[[], Any]
    _loaded = False

    def __init__(
        self,
        teacher: Teacher,
        reward: Callable[..., Sequence[float | None]],
        source: str | None = None,
    ) -> None:
        space: Any = teacher.space
        self._teacher, self._rows, self._reward = teacher, space.size, reward
        self._source = source
        self._told = 0  # number of generations
        self._again = False  # whether the next one repeats the last that was told
        update_wrapper(self, reward)  # TRL logs it by its name

    def attach(self, trainer: Any) -> None:
        """Makes the teacher draw a trainer's prompts; call it before training.

        Args:
            trainer: ``GRPOTrainer``, or another trainer that generates groups in the same way.

        Raises:
            ArgumentError: naming what does not fit in the trainer.
        """
        if self not in trainer.reward_funcs:
            raise ArgumentError("reward_funcs: must contain this TaughtReward, which tells results")
        rows, config = trainer.train_dataset, trainer.args
        count = f"{len(rows)} rows" if hasattr(rows, "__len__") else "a stream"
        if count != f"{self._rows} rows":
            raise ArgumentError(
                f"train_dataset: {count}, but must be a Dataset with one row for each of the "
                f"teacher's {self._rows} items"
            )
        for name in ("ignore_data_skip", "remove_unused_columns"):
            if getattr(config, name):
                raise ArgumentError(f"{name}=True: must be false")
        numbered = rows.add_column(ROW, [*range(self._rows)])
        self._group = config.generation_batch_size // config.num_generations
        self._rounds = config.steps_per_generation * config.num_iterations
        self._groups = -(-self._rows // self._group)  # of an epoch
        self._sampler = TeacherSampler(
            self._teacher,
            self._groups * self._group,
            repeat=config.num_generations,
            group=self._group,
            rounds=self._rounds,
            sources=None if self._source is None else [*rows[self._source]],
        )
        self._trainer, self._loader = trainer, trainer.get_train_dataloader
        trainer.train_dataset = numbered
        trainer.get_train_dataloader = self._taught_dataloader
        trainer.add_callback(self)

    def _taught_dataloader(self) -> Any:
        """Returns the trainer's loader, with the items that the teacher draws."""
        loader = self._loader()
        loader.set_sampler(self._sampler)  # a method of loaders that accelerate prepared
        return loader

    def __call__(self, completions: Sequence[Any], **columns: Any) -> Sequence[float | None]:
        """Returns the rewards; during training it also tells them to the teacher."""
        items = columns.pop(ROW, None)  # none in evaluation
        rewards = self._reward(completions=completions, **columns)
        if self._trainer.model.training:
            if not self._again:
                self._sampler.tell(items, rewards)
                self._told += 1
                if log := columns.get("log_metric"):
                    for name, value in self._sampler.metrics().items():
                        log(f"curriculum/{name}", value)
            self._again = False
        return rewards

    def load(self, folder: str | Path) -> None:
        """Loads the curriculum of a checkpoint that is not in the config's output_dir."""
        state = torch.load(Path(folder) / FILE, weights_only=True)
        self._teacher.load_state_dict(state["teacher"])
        self._sampler.load_state_dict(state["sampler"])
        self._sampler.rewind()  # since the trainer skips the batches that it has had
        self._told, self._loaded = state["told"], True

    def on_train_begin(self, args: Any, state: Any, control: Any, **_: Any) -> None:
        """Loads the curriculum of the step at which training is resumed."""
        if not state.global_step:  # items that an earlier training drew ahead have no results
            self._sampler.drop()
            self._told, self._loaded = 0, False
            return
        if not self._loaded:
            self.load(Path(args.output_dir) / f"checkpoint-{state.global_step}")
        self._loaded = False
        # Resumed within the steps of a generation, TRL generates it again, though it was told.
        per_step = args.gradient_accumulation_steps
        epoch, step = divmod(state.global_step, -(-self._groups * self._rounds // per_step))
        self._again = self._told > epoch * self._groups + step * per_step // self._rounds

    def on_save(self, args: Any, state: Any, control: Any, **_: Any) -> None:
        """Adds the curriculum to the checkpoint; it is the same on all ranks."""
        if args.should_save:
            made = {
                "teacher": self._teacher.state_dict(),
                "sampler": self._sampler.state_dict(),
                "told": self._told,
            }
            torch.save(made, Path(args.output_dir) / f"checkpoint-{state.global_step}" / FILE)
