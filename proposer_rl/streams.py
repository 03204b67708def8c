"""Named random streams: every draw's generator is a function of the seed and of what it is for."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager
from operator import index
from threading import RLock

import torch

DEFAULT = RLock()  # torch's default generator is one for all threads


class Streams:
    """Random generators addressed by name instead of by order of use.

    A generator's state depends only on the seed and its key, such as ``("actions", step, copy)``.
    So nothing has to be saved to resume a run, a new consumer of random numbers changes no other,
    and replicas draw the same numbers wherever and in whatever company they run.

    Args:
        seed: the run's seed.
        scope: keys put before every generator's own.

    Example:
        >>> streams = Streams(7)
        >>> first = torch.rand(2, generator=streams.generator("levels", 3))
        >>> again = torch.rand(2, generator=Streams(7).generator("levels", 3))
        >>> torch.equal(first, again)
        True
    """

    def __init__(self, seed: int, *scope: str | int) -> None:
        self._seed = index(seed)
        self._scope = [*map(_own, scope)]

    @property
    def address(self) -> list[str | int]:
        """Seed and scope: ``Streams(*address)`` are the same streams."""
        return [self._seed, *self._scope]

    def within(self, *scope: str | int) -> Streams:
        """Returns the streams below a further scope."""
        return Streams(self._seed, *self._scope, *scope)

    def generator(self, *key: str | int) -> torch.Generator:
        """Returns a new CPU generator for ``key``; equal keys give equal states.

        Numbers are drawn there for every device: generators of other devices draw others.
        """
        return torch.Generator().manual_seed(self._seed_of(*key))

    @contextmanager
    def as_default(self, *key: str | int) -> Iterator[None]:
        """Lets torch's default CPU generator draw from ``key`` inside the context only.

        For code that takes no generator, such as the initialisation of layers.
        """
        with DEFAULT, torch.random.fork_rng(devices=[]):
            # torch.manual_seed would seed the generators of GPUs, too.
            torch.default_generator.manual_seed(self._seed_of(*key))
            yield

    def _seed_of(self, *key: str | int) -> int:
        address = repr((self._seed, *self._scope, *map(_own, key))).encode()
        # 63 bits: the range that torch accepts on every device.
        return int.from_bytes(hashlib.blake2b(address, digest_size=8).digest(), "little") >> 1


def _own(key: str | int) -> str | int:
    """Returns a key as Python's own, since NumPy's has another representation."""
    return str(key) if isinstance(key, str) else index(key)
