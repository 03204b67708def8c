"""CurrOT on the bins: moves the distribution of levels to the target through mastered bins."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from proposer_rl.curricula.bins import BinCurriculum, Measure, Probes
from proposer_rl.curricula.student import Student
from proposer_rl.meta.assembly import Components
from proposer_rl.settings import ArgumentError, Count, Positive, Share, checked
from proposer_rl.streams import Streams
from proposer_rl.task import Space

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Bins for which a step takes about ten seconds: 250 items in a row take as long as 8³ bins.
MOST_IN_A_ROW, MOST_OF_A_GRID = 256, 512
NOTHING = 1e-6  # shares below this are rounding of the solver
SLACK = 1e-6  # of the reach, if the solver finds nothing at the nearest distribution itself


class TransportCurriculum(BinCurriculum):
    """Draws batches from a distribution that moves towards the target.

    Each scoring pass replaces the distribution over the bins by the one nearest to the target in
    the 2-Wasserstein distance of the space's coordinates, among those within epsilon of the current
    one and on bins where the student's performance is at least delta (Klink et al. 2022,
    "Curriculum Reinforcement Learning via Constrained Optimal Transport", ICML). If no bin is that
    good, the bins with the best performance count instead, so that the search begins with the
    easiest ones. The first distribution is uniform.

    See :func:`step_towards` for the linear program, and for what happens if the student forgets.

    Args:
        space: that has the bins.
        target_shares: the target as shares of the bins, float [N].
        delta: least performance of a bin that is drawn from.
        epsilon: largest move in a scoring pass; neighbouring bins of an axis with n values are
            about 2 / (n - 1) apart.
        every: number of batches between two scoring passes.
        probes: number of levels of each bin.
        measure: of performance, ``"success"`` or ``"return"``.
        exploration: uniform part of each batch while performance is below delta in all bins of the
            target. It shrinks with the share of the target where this is still so.

    Raises:
        ArgumentError: if there are too many bins.
    """

    shown = ("performance",)
    needs = ("performance",)
    state = (*BinCurriculum.state, "_probes")

    @checked
    def __init__(
        self,
        space: Space,
        target_shares: Tensor,
        *,
        delta: float = 0.3,
        epsilon: Positive = 0.3,
        every: Count = 5,
        probes: Count = 16,
        measure: Measure = "success",
        exploration: Share = 0.0,
    ) -> None:
        most = MOST_IN_A_ROW if len(space.axes) == 1 else MOST_OF_A_GRID
        if space.size > most:
            raise ArgumentError(
                f"space: {space.size:,} bins: optimal transport takes minutes on more than {most}; "
                "use fewer bins or items, or domain_randomization with filter=model, which has no "
                "limit"
            )
        super().__init__(space, every=every)
        self._exploration = exploration
        self._delta, self._epsilon = delta, epsilon
        self._probes = Probes(space, probes, measure)
        self._target = (target_shares.double() / target_shares.double().sum()).numpy()
        places = space.coordinates.double()
        apart = torch.cdist(places, places, compute_mode="donot_use_mm_for_euclid_dist")
        self._costs = apart.square().numpy()  # [N, N]

    @classmethod
    def create(cls, run: Components, **settings: Any) -> TransportCurriculum:
        """Makes it for a run's space and the target's shares of its bins."""
        return cls(run.task.space, run.task.target_shares, **settings)

    def score(self, student: Student, count: int, rng: Streams) -> None:
        """Moves the distribution by the student's performance on the probes."""
        performance = self._probes.performance(student, rng)
        # Where no bin is mastered, those of the best performance are allowed.
        allowed = performance >= performance.max().clamp(max=self._delta)
        even = torch.full(performance.shape, 1 / len(performance), dtype=torch.float64)
        now = self.scores.get("share", even).numpy()
        moved, left = step_towards(self._target, now, self._costs, allowed.numpy(), self._epsilon)
        share = torch.from_numpy(moved)
        share = share.where(share > NOTHING, 0.0)
        self.scores = {
            "share": share / share.sum(),
            "performance": performance,
            "allowed": allowed,
            "distance": torch.tensor(left).clamp(min=0).sqrt(),
        }

    def shares(self) -> Tensor:
        """Returns the shares of the bins in the next batch, float [N]."""
        share = self.scores["share"]
        ahead = torch.from_numpy(self._target) * (self.scores["performance"] < self._delta)
        part = self._exploration * ahead.sum()
        return (1 - part) * share + part / len(share)

    def log(self) -> dict[str, Any]:
        """Adds the number of allowed bins and the distance W2 to the target."""
        record = super().log()
        if record:
            record["allowed_bins"] = int(self.scores["allowed"].sum())
            record["target_distance"] = float(self.scores["distance"])
        return record


def step_towards(
    target: Floats, now: Floats, costs: Floats, allowed: Mask, reach: float
) -> tuple[Floats, float]:
    """Returns the distribution nearest to the target that is on allowed bins and within reach.

    The minimum of W2(p, target) over distributions p with W2(p, now) <= reach and p = 0 where not
    allowed (Klink et al. 2022, "Curriculum Reinforcement Learning via Constrained Optimal
    Transport", ICML, the optimization problem of the method). With couplings A of p and the target
    and B of p and the present distribution it is a linear program:

        minimise <C, A>  with  A >= 0, B >= 0, A 1 = B 1 = p, A'1 = target, B'1 = now,
                               <C, B> <= reach^2.

    If the current distribution is no longer on allowed bins, there may be nothing on them within
    reach; the reach then extends to the nearest distribution on them.

    Args:
        target: shares that add up to one, [N].
        now: shares that add up to one, [N].
        costs: squared distances between bins, [N, N].
        allowed: at least one bin, [N].
        reach: not negative.

    Returns:
        p [N]; W2(p, target) squared.

    Raises:
        RuntimeError: if the program cannot be solved.

    Example:
        Three bins in a row, one apart. A reach of 0.5 allows a quarter of the mass to go one bin:

        >>> places = np.arange(3.0)
        >>> costs = (places[:, None] - places) ** 2
        >>> first, last = np.eye(3)[0], np.eye(3)[2]
        >>> p, left = step_towards(last, first, costs, np.ones(3, bool), 0.5)
        >>> p.round(6).tolist(), round(left, 6)
        ([0.75, 0.25, 0.0], 3.25)
    """
    # SciPy's solvers take long to import, and no other curriculum needs them.
    from scipy import sparse
    from scipy.optimize import linprog

    def sums(shape: tuple[int, int], over: int) -> sparse.coo_array:
        """Returns the map from a matrix of that shape, row by row, to its sums over an axis."""
        kept, summed = sparse.eye_array(shape[1 - over]), np.ones((1, shape[over]))
        return sparse.kron(summed, kept) if over == 0 else sparse.kron(kept, summed)

    rows, to, fro = (np.flatnonzero(mask) for mask in (allowed, target > 0, now > 0))
    nearest = costs[np.ix_(rows, fro)].min(0) @ now[fro]  # of all on allowed bins, squared
    count = len(rows)
    shape_a, shape_b = (count, len(to)), (count, len(fro))
    none_a = sparse.coo_array((len(fro), count * len(to)))
    none_b = sparse.coo_array((len(to), count * len(fro)))
    equal = sparse.block_array(
        [
            [sums(shape_a, over=0), none_b],
            [none_a, sums(shape_b, over=0)],
            [sums(shape_a, over=1), -sums(shape_b, over=1)],
        ]
    )
    cost_a, cost_b = (costs[np.ix_(rows, columns)].ravel() for columns in (to, fro))
    for slack in (0.0, SLACK):
        result = linprog(
            np.concatenate([cost_a, np.zeros_like(cost_b)]),
            A_ub=np.concatenate([np.zeros_like(cost_a), cost_b])[None],
            b_ub=[max(reach**2, nearest * (1 + slack))],
            A_eq=equal.tocsr(),
            b_eq=np.concatenate([target[to], now[fro], np.zeros(count)]),
            method="highs",
            # Presolving would take rounding, 1e-16 in the sums of shares, for a contradiction.
            options={"presolve": False},
        )
        if result.x is not None:
            break
    else:
        raise RuntimeError(f"the transport to the target cannot be computed: {result.message}")
    p = np.zeros_like(target)
    p[rows] = result.x[: cost_a.size].reshape(shape_a).sum(1).clip(0)
    return p / p.sum(), float(result.fun)
