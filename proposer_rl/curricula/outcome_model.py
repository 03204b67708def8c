"""Predicts what a student would reach on any level, from the levels that it trained on.

Every update provides labelled data, levels and their outcomes, at no extra cost. A logistic
regression on the rows phi_i of the last batches, with outcomes y_i, gives the probability of
success. A row that is ``age`` batches old has the weight

    w_i = 2 ** (-age_i / half_life).

Because students get better, one of the features is -age_i / half_life. It is 0 for a prediction, so
the model extrapolates the trend over time to the present. The regression minimises

    sum_i w_i (log(1 + exp(z_i)) - y_i z_i) + ridge / 2 |beta|^2,    z_i = beta . phi_i.

With H = sum_i w_i p_i (1 - p_i) phi_i phi_i' + ridge I, the curvature at the minimum, beta is about
normal with the covariance H^-1 (Laplace's approximation), z of a level with s^2 = phi' H^-1 phi,
and the expectation of 1 / (1 + exp(-z)) about

    p = 1 / (1 + exp(-z / sqrt(1 + pi s^2 / 8)))

(MacKay 1992, "The evidence framework applied to classification networks", Neural Computation 4).
Where there are no data it is near one half for any beta.

The mean of the return comes from a linear regression. With r_i the returns, standardised to a
weighted mean of 0 and deviation of 1,

    minimise  sum_i w_i (r_i - a . phi_i)^2 + ridge |a|^2.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Annotated, Any, Literal, NamedTuple

import torch
from annotated_types import Ge
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from proposer_rl.curricula.batches import device_of, finite, saved
from proposer_rl.curricula.combinators import Combinator
from proposer_rl.curricula.contract import Batch, Curriculum, proposed
from proposer_rl.curricula.student import ABILITIES, Student
from proposer_rl.meta.assembly import Components
from proposer_rl.settings import Positive, checked
from proposer_rl.streams import Streams
from proposer_rl.task import Levels

Labels = Literal["success", "above_worst"]
Features = Callable[[Levels], Tensor]
"""Maps levels [K, n] to the features of a model: float [K, n, F], each about -1 to 1."""

KEPT = 4  # half-lives after which a batch is forgotten
STEPS = 50  # of Newton's method, at most
HALVINGS = 8  # of a step, at most, until it makes the loss no larger
CLOSE = 1e-10  # coefficients have converged when they change by less than this
EQUAL = 1e-6  # relative difference up to which returns count as equal

ANSWERED = ("performance", "exact_performance")
LOGGED = 100  # batches at most whose predictions are kept for a log, which loops may never ask for
PARTS = 10  # intervals of [0, 1] in which predictions are compared with outcomes


def logistic_ridge(
    features: Tensor, labels: Tensor, weights: Tensor, ridge: float
) -> tuple[Tensor, Tensor]:
    """Fits a logistic regression by Newton's method; all coefficients are penalised.

    Args:
        features: float64 [m, F].
        labels: in [0, 1], float64 [m].
        weights: of the rows, not negative, float64 [m].
        ridge: above 0.

    Returns:
        Coefficients beta, float64 [F], and their covariance, float64 [F, F].
    """
    prior = ridge * torch.eye(features.shape[-1], dtype=features.dtype)

    def at(beta: Tensor) -> tuple[Tensor, Tensor]:
        """Returns log odds [m], and the loss []."""
        z = features @ beta
        misfit = torch.nn.functional.softplus(z) - labels * z
        return z, (weights * misfit).sum() + ridge / 2 * beta.square().sum()

    def curvature(p: Tensor) -> Tensor:
        return features.mT @ (features * (weights * p * (1 - p)).unsqueeze(-1)) + prior

    beta = features.new_zeros(features.shape[-1])
    z, now = at(beta)
    for _ in range(STEPS):
        p = z.sigmoid()
        slope = features.mT @ (weights * (p - labels)) + ridge * beta
        step = torch.linalg.solve(curvature(p), slope)
        for halvings in range(HALVINGS + 1):
            z, then = at(beta - step)
            if halvings == HALVINGS or not then > now:
                break
            step = step / 2
        beta, now = beta - step, then
        if bool((step.abs() < CLOSE).all()):
            break
    return beta, torch.linalg.inv(curvature(z.sigmoid()))


def linear_ridge(features: Tensor, values: Tensor, weights: Tensor, ridge: float) -> Tensor:
    """Fits a linear regression to values float64 [m]; the rest is as in :func:`logistic_ridge`.

    Returns:
        Coefficients, float64 [F], all of which are penalised.
    """
    weighted = features.mT * weights
    prior = ridge * torch.eye(features.shape[-1], dtype=features.dtype)
    return torch.linalg.solve(weighted @ features + prior, weighted @ values)


class OutcomeModel:
    """Predicts what a student would reach on levels, from the outcomes of recent batches.

    Args:
        labels: the event whose probability is predicted: ``"success"``, an entry of outcomes; or
            ``"above_worst"``, a return above the lowest ever seen. The two agree if all failures
            have the same return. If every step is rewarded, nearly every episode is above the
            worst, so that every level has some probability.
        ridge: penalty on the coefficients.
        half_life: number of batches after which a row has half its weight.

    Attributes:
        required_results: entries of an outcome that it needs.
    """

    def __init__(
        self, *, labels: Labels = "success", ridge: float = 0.3, half_life: float = 12.0
    ) -> None:
        self._labels, self._ridge, self._half_life = labels, ridge, half_life
        # Entries that are not required may be missing in some outcomes.
        self.required_results = ("return", "success") if labels == "success" else ("return",)
        self._batches: list[dict[str, Tensor]] = []
        self._worst = torch.tensor(torch.inf, dtype=torch.float64)
        self._fitted: _Fitted | None = None

    def add(self, features: Tensor, outcome: Mapping[str, Tensor], *, as_old: bool = False) -> None:
        """Adds a batch to the training data.

        Args:
            features: float64 [m, F]; a constant feature acts as an intercept.
            outcome: the entries in ``required_results``, float64 [m].
            as_old: whether these rows belong to the batch that was added last.
        """
        batch = {"features": features, **{name: outcome[name] for name in self.required_results}}
        if as_old:
            *self._batches, before = self._batches
            batch = {name: torch.cat([before[name], batch[name]]) for name in batch}
        self._batches = [*self._batches, batch][-round(KEPT * self._half_life) :]
        self._worst = torch.minimum(self._worst, outcome["return"].amin())
        self._fitted = None

    def predict(self, features: Tensor) -> TensorDict:
        """Predicts the outcome of levels with features float64 [n, F]: a tensordict [n].

        It has ``success`` and ``return``, each float64. Without any rows they are 0.5 and 0.
        """
        shape = features.shape[:1]
        if not self._batches:
            same = {"success": 0.5, "return": 0.0}
            return TensorDict({k: features.new_full(shape, v) for k, v in same.items()}, shape)
        self._fitted = fitted = self._fitted or self._fit()
        phi = torch.cat([torch.zeros_like(features[..., :1]), features], -1)  # of age 0
        z = phi @ fitted.beta
        variance = ((phi @ fitted.covariance) * phi).sum(-1)
        return TensorDict(
            {
                "success": (z / (1 + math.pi / 8 * variance).sqrt()).sigmoid(),
                "return": fitted.middle + fitted.unit * (phi @ fitted.mean),
            },
            shape,
        )

    def labels(self, outcome: Mapping[str, Tensor]) -> Tensor:
        """Converts an outcome to the labels in [0, 1] that the model fits: float64 [m]."""
        if self._labels == "success":
            return outcome["success"]
        worst = torch.minimum(self._worst, outcome["return"].amin())
        return (outcome["return"] > worst + EQUAL * (1 + worst.abs())).double()

    def state_dict(self) -> dict[str, Any]:
        """Returns the training data and the lowest return so far."""
        return {"batches": [dict(batch) for batch in self._batches], "worst": self._worst}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restores what :meth:`state_dict` returned."""
        self._batches = [dict(batch) for batch in state["batches"]]
        self._worst, self._fitted = state["worst"], None

    def _fit(self) -> _Fitted:
        entries = {
            name: torch.cat([batch[name] for batch in self._batches])
            for name in ("features", *self.required_results)
        }
        ages = torch.cat(
            [
                torch.full_like(batch["return"], (len(self._batches) - number) / self._half_life)
                for number, batch in enumerate(self._batches, 1)
            ]
        )
        weights = 0.5**ages
        share = weights / weights.sum()
        middle = (share * entries["return"]).sum()
        unit = (share * (entries["return"] - middle).square()).sum().sqrt()
        unit = unit.where(unit > EQUAL * (1 + middle.abs()), 1.0)  # returns that are all alike
        phi = torch.cat([-ages.unsqueeze(-1), entries["features"]], -1)
        returns = (entries["return"] - middle) / unit
        return _Fitted(
            *logistic_ridge(phi, self.labels(entries), weights, self._ridge),
            middle,
            unit,
            linear_ridge(phi, returns, weights, self._ridge),
        )


class Modelled(Combinator):
    """Runs a curriculum on predictions of the student's performance instead of evaluations.

    When a scoring pass or a filter of the curriculum asks for ``performance`` or
    ``exact_performance``, an :class:`~proposer_rl.curricula.outcome_model.OutcomeModel` answers. It
    is fitted to the outcomes of the levels on which the student trained, so it costs no frames and
    no evaluations, and needs no oracle.

    Args:
        curriculum: any curriculum.
        features: of levels, such as ``task.features``, or those of a space alone; see
            :func:`~proposer_rl.task.space_features`.
        labels, ridge, half_life: see the model.
    """

    state = ("_model", "_seen", "_has_observed")

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
        if labels == "success" and "success" not in self.required_results:
            self.required_results = (*self.required_results, "success")
        self._features, self._labels = features, labels
        self._model = OutcomeModel(labels=labels, ridge=ridge, half_life=half_life)
        self._has_observed = False  # whether anything since the last proposal
        self._seen = Predictions()

    @classmethod
    def around(cls, curriculum: Curriculum, run: Components, **settings: Any) -> Modelled:
        """Makes it for a run whose task has features of levels.

        Raises:
            ArgumentError: if they have none.
        """
        run.task.features(run.task.space.sample(1, torch.Generator())[None])
        return cls(curriculum, run.task.features, **settings)

    def propose(self, student: Student, count: int, rng: Streams) -> Batch:
        """Returns what the curriculum proposes to a student whose performance is predicted."""
        self._has_observed = False
        batch = proposed(self.parts[0], _answering(student, self._predict), count, rng)
        phi = self._phi(batch.levels)
        predicted = self._model.predict(phi)["success"]
        notes = {"features": phi, "predicted": predicted, "notes": batch.notes}
        return Batch(batch.levels, TensorDict(notes, [count]))

    def observe(self, student: Student, batch: Batch, outcome: TensorDictBase) -> None:
        """Adds the outcome to the training data of the model, and passes it on to the curriculum.

        All that is observed between two proposals counts as one batch.
        """
        notes = batch.notes
        reached = {name: outcome[name].double().cpu() for name in self._model.required_results}
        self.parts[0].observe(student, Batch(batch.levels, notes["notes"], batch.size), outcome)
        self._seen.add(notes["predicted"], self._model.labels(reached))
        self._model.add(notes["features"], reached, as_old=self._has_observed)
        self._has_observed = True

    def improve(self, student: Student, rng: Streams) -> dict[str, Any]:
        """Improves the curriculum with a student whose performance is predicted."""
        return super().improve(_answering(student, self._predict), rng)

    def log(self) -> dict[str, Any]:
        """Adds how accurate the predictions were; see :func:`calibration`."""
        return super().log() | self._seen.log()

    def _predict(self, levels: Levels) -> TensorDict:
        return self._model.predict(self._phi(levels)).to(device_of(levels))

    def _phi(self, levels: Levels) -> Tensor:
        return finite("features", self._features(levels.unsqueeze(0))[0])


class Predictions:
    """Keeps predictions and outcomes of levels until the next log."""

    def __init__(self) -> None:
        self._seen: list[list[Tensor]] = []

    def add(self, predicted: Tensor, label: Tensor) -> None:
        """Adds probabilities and labels of a batch, float64 [m] each."""
        self._seen = [*self._seen[1 - LOGGED :], [predicted, label]]

    def log(self) -> dict[str, Any]:
        """Returns the :func:`calibration` of what was added, if anything was, and starts anew."""
        seen, self._seen = self._seen, []
        return calibration(*(torch.cat(one) for one in zip(*seen, strict=True))) if seen else {}

    def state_dict(self) -> dict[str, Any]:
        """Returns what was added since the last log."""
        return {"seen": saved(self._seen)}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restores what :meth:`state_dict` returned."""
        self._seen = saved(state["seen"])


def calibration(predicted: Tensor, label: Tensor) -> dict[str, Any]:
    """Compares probabilities that were predicted with what happened, ready for JSON.

    ``brier`` is the mean squared error of the probabilities, and ``brier_constant`` that of the
    best constant. ``reliability`` has for each tenth of the probabilities the number of
    predictions, their mean, and the mean of the labels.

    Args:
        predicted: probabilities float64 [m].
        label: in [0, 1], float64 [m].
    """
    part = (predicted * PARTS).long().clamp(max=PARTS - 1)
    sums = [
        torch.zeros(PARTS, dtype=torch.float64).scatter_add(0, part, values)
        for values in (torch.ones_like(label), predicted, label)
    ]
    means = [(total / sums[0].clamp(min=1)).tolist() for total in sums[1:]]
    return {
        "brier": float((predicted - label).square().mean()),
        "brier_constant": float((label - label.mean()).square().mean()),
        "reliability": {
            "levels": sums[0].long().tolist(),
            "predicted": means[0],
            "reached": means[1],
        },
    }


class _Fitted(NamedTuple):
    """Coefficients of the fitted regressions, and the mean and deviation of returns."""

    beta: Tensor
    covariance: Tensor
    middle: Tensor
    unit: Tensor
    mean: Tensor


def _answering(student: Student, predict: Callable[[Levels], TensorDict]) -> Student:
    """Returns a student whose performance is predicted, and who does everything else itself."""
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
