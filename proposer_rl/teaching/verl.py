"""A curriculum of prompts in verl, which makes the sampler that its config names."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from typing import Any

from verl.experimental.dataset.sampler import AbstractCurriculumSampler

from proposer_rl.recipes import DEFAULT_METHOD, recipe_function
from proposer_rl.settings import ArgumentError, plain
from proposer_rl.teaching.sampler import TeacherSampler
from proposer_rl.teaching.spaces import Items
from proposer_rl.teaching.teacher import Teacher

NAMES = ("method", "settings", "features", "pass_rates", "source", "success")


class TaughtSampler(TeacherSampler, AbstractCurriculumSampler):
    """A sampler of prompts for verl, by ``data.sampler`` of its config.

        class_path: pkg://proposer_rl.teaching.verl
        class_name: TaughtSampler
        method: mopps                   # settings: {...} of it
        features: [extra_info.level]    # columns of numbers or texts
        pass_rates: extra_info.solved   # a column, as of another model
        source: data_source             # a column by which metrics are given, too
        success: acc                    # of a batch, from 0 to 1; else the sum of its scores

    Prompts are recognised by ``data_source`` and ``extra_info.index``; an epoch has whole batches.
    The data loader's state holds the curriculum. As verl saves a step's checkpoint before it
    updates the sampler, that step's answers are lost to a resumed curriculum, which drops them.

    Raises:
        ArgumentError: naming a setting that is unknown, a column that is missing, or prompts that
            cannot be distinguished.
    """

    def __init__(self, data_source: Any, data_config: Any) -> None:
        told = plain(data_config.sampler)
        for name in told:
            if name not in (*NAMES, "class_path", "class_name"):
                known = ", ".join(NAMES)
                raise ArgumentError(f"data.sampler.{name}: unknown; there are: {known}")
        rows = data_source.dataframe

        def column(name: str | None) -> list[Any] | None:
            return None if name is None else _column(rows, name)

        ways = (_column(rows, name) for name in ("data_source", "extra_info.index"))
        keys = [*zip(*ways, strict=True)]
        self._places = {key: place for place, key in enumerate(keys)}
        if len(self._places) < len(keys):
            raise ArgumentError("extra_info.index: must differ within a data_source")
        named = told.get("features") or ()
        features = {name: column(name) for name in ([named] if isinstance(named, str) else named)}
        rates = column(told.get("pass_rates"))
        items = Items(len(keys), features=features or None, pass_rates=rates)
        batch = data_config.get("gen_batch_size") or data_config.train_batch_size
        if batch > len(keys):
            raise ArgumentError(f"data.train_batch_size={batch}: is more than {len(keys)} prompts")
        make = recipe_function("method", told.get("method") or DEFAULT_METHOD)
        recipe = make(**(told.get("settings") or {}))
        teacher = Teacher(recipe, items, seed=data_config.get("seed") or 0, block=batch)
        sources = column(told.get("source"))
        super().__init__(teacher, len(keys) // batch * batch, sources=sources)
        self._success = told.get("success")

    def update(self, batch: Any) -> None:
        """Reports the answers of a batch, of which a group has one ``uid``."""
        known = batch.non_tensor_batch
        if self._success is None:
            scores = batch.batch["token_level_scores"].sum(-1).tolist()
        elif self._success in known:
            scores = known[self._success]
        else:
            has = ", ".join(known)
            raise ArgumentError(f"data.sampler.success={self._success}: a batch has: {has}")
        groups: dict[Any, list[float]] = defaultdict(list)
        each = zip(known["data_source"], known["extra_info"], known["uid"], scores, strict=True)
        for source, extra, uid, score in each:
            groups[self._places[source, extra["index"]], uid].append(float(score))
        self.tell(
            [item for item, _ in groups],
            [sum(group) / len(group) for group in groups.values()],
            episodes=[len(group) for group in groups.values()],
        )

    def state_dict(self) -> dict[str, Any]:
        """Returns the state of the curriculum, and the place in the epoch."""
        return {"teacher": self._teacher.state_dict(), **super().state_dict()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Puts back a state, and drops what was out then."""
        self._teacher.load_state_dict(state["teacher"])
        super().load_state_dict(state)
        self.drop([item for item, tickets in self._out.items() for _ in tickets])


def _column(rows: Any, name: str) -> list[Any]:
    """Returns a column of a table, or ``COLUMN.KEY`` of one of mappings."""
    first, *keys = name.split(".")
    try:
        values = [*rows[first]]
        for key in keys:
            values = [value[key] for value in values]
    except (KeyError, TypeError) as error:
        raise ArgumentError(f"data: has no column {name}, or not in all rows") from error
    return values
