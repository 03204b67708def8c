"""Curricula without an oracle: a model of outcomes answers what they ask about performance."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any

import torch
from annotated_types import Ge
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from proposer_rl.curricula.batches import device_of
from proposer_rl.curricula.combinators import Combinator
from proposer_rl.curricula.contract import Batch, Curriculum, Improvement, Inbox
from proposer_rl.curricula.outcome_model import Labels, OutcomeModel
from proposer_rl.curricula.student import ABILITIES, Student
from proposer_rl.settings import Positive, checked
from proposer_rl.streams import Streams
from proposer_rl.task import Levels

Features = Callable[[Levels], Tensor]
"""What a model knows of levels [K, n] by themselves: float [K, n, F], each about -1 to 1."""

ANSWERED = ("performance", "exact_performance")
FIRST = 128  # levels that came back first, by which it is judged what the labels say
ALIKE = 0.95  # share of them with one label, beyond which that is nearly nothing
WRONG = 0.1  # share of them that were told another success, beyond which it should be read
PARTS = 10  # of the probabilities from 0 to 1, in which what was predicted is compared


class Modelled(Combinator):
    """A curriculum that asks a model of outcomes instead of the student how well it does.

    Whatever the curriculum asks as ``performance`` or ``exact_performance``, by a scoring pass or a
    filter, an :class:`~proposer_rl.curricula.outcome_model.OutcomeModel` answers, which is fitted
    to what came of the levels that the student was trained on. That costs no frames, no
    evaluations and no oracle.

    Args:
        curriculum: any.
        features: of levels, such as ``task.features`` or a space's alone, see
            :func:`~proposer_rl.task.space_features`.
        labels, ridge, half_life: see the model.
    """

    remembers = ("_model", "_inbox", "_told", "_has_taken")

    @checked
    def __init__(
        self,
        curriculum: Curriculum,
        features: Features,
        *,
        labels: Labels = "above_worst",
        ridge: Positive = 0.3,
        half_life: Annotated[float, Ge(1)] = 12.0,
    ) -> None:
        super().__init__([curriculum])
        self.needs = tuple(need for need in self.needs if need not in ANSWERED)
        if labels == "success" and "success" not in self.reads:
            self.reads = (*self.reads, "success")
        self._features, self._labels = features, labels
        self._model = OutcomeModel(labels=labels, ridge=ridge, half_life=half_life)
        self._inbox = Inbox()
        self._has_taken = False  # whether anything since the last proposal, as logs make it
        self._told: list[dict[str, Tensor]] = []  # what was predicted, and what it was, [K, m]
        self._first: list[Tensor] | None = []  # that came back, [2, K, n]; None once judged

    def propose(self, student: Student, count: int, streams: Sequence[Streams]) -> Batch:
        """What the curriculum proposes to a student of whom the model speaks."""
        self._take_in()
        self._has_taken = False
        batch = self.parts[0].propose(_answering(student, self._predict), count, streams)
        phi = self._phi(batch.levels)
        predicted = self._model.predict(phi)["success"]
        return self._inbox.batch(batch.levels, features=phi, predicted=predicted, notes=batch.notes)

    def observe(self, student: Student, batch: Batch, outcome: TensorDictBase) -> None:
        """Put the outcome aside for the model, and pass it on.

        Raises:
            ValueError: if the outcome tells no success and success is what is labelled.
        """
        self._inbox.check(batch, outcome)
        if self._labels == "success" and "success" not in outcome.keys():
            raise ValueError("labels=success: the outcome has no success; above_worst needs none")
        reached = {name: outcome[name].double() for name in self._model.reads}
        self.parts[0].observe(student, Batch(batch.levels, batch.notes["notes"]), outcome)
        self._inbox.put(batch, **batch.notes.select("features", "predicted"), **reached)
        if self._first is not None and self._labels == "above_worst":
            self._judge(outcome)

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on with it; what comes back next is not the first any more."""
        super().load_state_dict(state)
        self._first = None

    def improve(self, student: Student, streams: Sequence[Streams]) -> Improvement:
        """Improve the curriculum, by what the model says of the student."""
        return super().improve(_answering(student, self._predict), streams)

    def log(self) -> dict[str, Any]:
        """Besides, how right the model was about the levels that came back, before it saw them.

        ``brier``, the mean squared error of the predicted probabilities, and ``brier_constant``,
        that of one number for all; ``reliability``, for each tenth of the probabilities how many
        were predicted there, their mean, and the mean of what it was; of each student.
        """
        self._take_in()
        log = super().log()
        if not self._told:
            return log
        predicted, label = (
            torch.cat([told[name] for told in self._told], 1) for name in ("predicted", "label")
        )
        self._told = []
        part = (predicted * PARTS).long().clamp(max=PARTS - 1)
        sums = [
            torch.zeros(len(part), PARTS, dtype=torch.float64).scatter_add(1, part, values)
            for values in (torch.ones_like(label), predicted, label)
        ]
        means = [(total / sums[0].clamp(min=1)).tolist() for total in sums[1:]]
        constant = (label - label.mean(1, keepdim=True)).square().mean(1)
        return log | {
            "brier": (predicted - label).square().mean(1).tolist(),
            "brier_constant": constant.tolist(),
            "reliability": {
                "levels": sums[0].long().tolist(),
                "predicted": means[0],
                "reached": means[1],
            },
        }

    def _judge(self, outcome: TensorDictBase) -> None:
        """Warn where the first levels that come back show that their labels say little."""
        returns = outcome["return"].double().cpu()
        success = outcome.get("success", torch.full_like(returns, torch.nan)).double().cpu()
        self._first = [*(self._first or []), torch.stack([returns, success])]
        first = torch.cat(self._first, -1)  # [2, K, m]
        if first.shape[-1] < FIRST:
            return
        self._first = None
        label = OutcomeModel(labels="above_worst").labels({"return": first[0]})
        wrong = (first[1] - label).abs().nanmean()  # NaN where none was told
        found = f"labels=above_worst: {float(label.mean()):.0%} of the first returns are that"
        if wrong > WRONG:
            warnings.warn(
                f"{found}, and not the success that was told, which labels=success reads",
                stacklevel=2,
            )
        elif wrong.isnan() and label.mean() > ALIKE:
            warnings.warn(
                f"{found}, so that the labels say nearly nothing; give labels=success, and tell it",
                stacklevel=2,
            )

    def _take_in(self) -> None:
        """Take in what came back since the last proposal, of whichever batches: it has one age."""
        if not (taken := self._inbox.take()):
            return
        evidence: Any = torch.cat(taken, 1)
        label = self._model.labels(evidence)
        self._told.append({"predicted": evidence["predicted"], "label": label})
        self._model.add(evidence["features"], evidence, as_old=self._has_taken)
        self._has_taken = True

    def _predict(self, levels: Levels) -> TensorDict:
        return self._model.predict(self._phi(levels)).to(device_of(levels))

    def _phi(self, levels: Levels) -> Tensor:
        phi = self._features(levels).double().cpu()
        wrong = (~phi.isfinite()).sum()
        if wrong:
            raise ValueError(f"features: {int(wrong)} of {phi.numel()} numbers are not finite")
        return phi


def _answering(student: Student, predict: Callable[[Levels], TensorDict]) -> Student:
    """A student whose performance a model tells; all else it does itself."""
    own = [name for name in ABILITIES if name not in ANSWERED and student.lacks(name) is None]
    answering = Student(
        gamma=student.gamma,
        lmbda=student.lmbda,
        batch_size=student.batch_size,
        **{name: getattr(student, name) for name in own},
        performance=lambda levels, generator: predict(levels),
        exact_performance=predict,
    )
    answering.spend = student.spend  # type: ignore[method-assign]
    return answering
