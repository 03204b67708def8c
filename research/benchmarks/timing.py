"""Timing things side by side: A B A B, so that a busy machine slows all of them alike."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from itertools import product

import torch
from tqdm import tqdm

from proposer_rl.learning.graphs import WARM_UPS
from research.benchmarks.results import Spread

Timings = dict[str, list[float]]


def interleave(
    candidates: Mapping[str, Callable[[], object]],
    repeats: int,
    device: str = "cpu",
    warmup: int | None = None,
) -> Timings:
    """Time every candidate once per round, in turn.

    Args:
        candidates: what to call, by name.
        repeats: rounds that count.
        device: whose queue is waited for before and after each call.
        warmup: rounds before them that do not count; None for one, or on a GPU for as many as it
            takes until everything has been recorded.

    Returns:
        Seconds of each candidate, one number per round.
    """
    if warmup is None:
        warmup = 1 if torch.device(device).type == "cpu" else WARM_UPS + 1
    seconds: Timings = {name: [] for name in candidates}
    turns = [*product(range(warmup + repeats), candidates)]
    bar = tqdm(turns, "timing", leave=False, disable=None)
    for turn, name in bar:
        bar.set_postfix_str(name)
        elapsed = time_once(candidates[name], device)
        if turn >= warmup:
            seconds[name].append(elapsed)
    return seconds


def time_once(call: Callable[[], object], device: str = "cpu") -> float:
    """Seconds of one call, until the device has finished it."""
    synchronise(device)
    start = time.perf_counter()
    call()
    synchronise(device)
    return time.perf_counter() - start


def synchronise(device: str) -> None:
    """Wait until the device has done all that was asked of it; a CPU has."""
    if torch.device(device).type == "cuda":
        torch.cuda.synchronize(device)


@contextmanager
def threads(count: int | None) -> Iterator[None]:
    """Let torch use that many threads for an operation meanwhile; None changes nothing."""
    before = torch.get_num_threads()
    torch.set_num_threads(count or before)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def ratio(above: list[float], below: list[float], factor: float = 1.0) -> Spread:
    """Spread of ``factor * above / below``, taken round by round: both saw the same machine."""
    return Spread.of([factor * a / b for a, b in zip(above, below, strict=True)])


def rate(count: int, seconds: list[float]) -> Spread:
    """Spread of how many things were done per second."""
    return Spread.of([count / s for s in seconds])


def total(timings: Timings, weights: Mapping[str, float]) -> list[float]:
    """Weighted sum of candidates, round by round."""
    rounds = zip(*(timings[name] for name in weights), strict=True)
    return [sum(w * s for w, s in zip(weights.values(), r, strict=True)) for r in rounds]
