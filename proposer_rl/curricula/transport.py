"""Optimal transport between distributions over bins, solved exactly as linear programs."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.optimize import linprog

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]


def step_towards(
    target: Floats, now: Floats, costs: Floats, allowed: Mask, reach: float
) -> tuple[Floats, float]:
    """The distribution nearest to the target among those near the present one, on allowed bins.

    The minimum of W2(p, target) over distributions p with W2(p, now) <= reach and p = 0 where not
    allowed (Klink et al. 2022, "Curriculum Reinforcement Learning via Constrained Optimal
    Transport", ICML, the optimization problem of the method). With couplings A of p and the target
    and B of p and the present distribution it is a linear program:

        minimise <C, A>  with  A >= 0, B >= 0, A 1 = B 1 = p, A'1 = target, B'1 = now,
                               <C, B> <= reach^2.

    Where the present distribution is not on allowed bins any more, it may be that nothing on them
    is within reach; reach is then that of the nearest distribution on them.

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
    rows, to, fro = (np.flatnonzero(mask) for mask in (allowed, target > 0, now > 0))
    nearest = costs[np.ix_(rows, fro)].min(0) @ now[fro]  # of all on allowed bins, squared
    count = len(rows)
    shape_a, shape_b = (count, len(to)), (count, len(fro))
    none_a = sparse.coo_array((len(fro), count * len(to)))
    none_b = sparse.coo_array((len(to), count * len(fro)))
    equal = sparse.block_array(
        [
            [_sums(shape_a, over=0), none_b],
            [none_a, _sums(shape_b, over=0)],
            [_sums(shape_a, over=1), -_sums(shape_b, over=1)],
        ]
    )
    cost_a, cost_b = (costs[np.ix_(rows, columns)].ravel() for columns in (to, fro))
    found = linprog(
        np.concatenate([cost_a, np.zeros_like(cost_b)]),
        A_ub=np.concatenate([np.zeros_like(cost_a), cost_b])[None],
        b_ub=[max(reach**2, nearest)],
        A_eq=equal.tocsr(),
        b_eq=np.concatenate([target[to], now[fro], np.zeros(count)]),
        method="highs",
        # Presolving takes what the shares are off by, 1e-16 in their sums, for a contradiction.
        options={"presolve": False},
    )
    if found.x is None:
        raise RuntimeError(f"the transport to the target cannot be computed: {found.message}")
    p = np.zeros_like(target)
    p[rows] = found.x[: cost_a.size].reshape(shape_a).sum(1).clip(0)
    return p / p.sum(), float(found.fun)


def _sums(shape: tuple[int, int], over: int) -> sparse.coo_array:
    """What maps a matrix of that shape, row by row, to its sums over an axis."""
    kept, summed = sparse.eye_array(shape[1 - over]), np.ones((1, shape[over]))
    return sparse.kron(summed, kept) if over == 0 else sparse.kron(kept, summed)
