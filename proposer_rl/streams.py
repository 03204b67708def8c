"""Named random streams: the generator of a draw depends only on the seed and on its purpose."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager
from operator import index
from threading import RLock

import torch

DEFAULT = RLock()  # all threads share torch's default generator


class Streams:
    """Makes random generators by name, independent of the order of use.

    The state of a generator depends on the seed and a key alone, such as ``("actions", step, k)``.
    So a run can be resumed without saving generators, a new use of random numbers does not change
    the others, and replicas draw the same numbers wherever they run.

    Args:
        seed: the run's seed.
        scope: keys that precede the key of every generator.

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
        """Seed and scope; ``Streams(*address)`` makes the same streams."""
        return [self._seed, *self._scope]

    def within(self, *scope: str | int) -> Streams:
        """Returns streams with a longer scope."""
        return Streams(self._seed, *self._scope, *scope)

    def generator(self, *key: str | int) -> torch.Generator:
        """Returns a new CPU generator for ``key``; equal keys give equal states.

        Draw on the CPU for every device: generators of other devices draw other numbers.
        """
        return torch.Generator().manual_seed(self._seed_of(*key))

    @contextmanager
    def as_default(self, *key: str | int) -> Iterator[None]:
        """Lets torch's default CPU generator draw from ``key`` within the context.

        For code that takes no generator, such as the initialisation of layers.
        """
        with DEFAULT, torch.random.fork_rng(devices=[]):
            # torch.manual_seed would also seed the generators of GPUs.
            torch.default_generator.manual_seed(self._seed_of(*key))
            yield

    def _seed_of(self, *key: str | int) -> int:
        address = repr((self._seed, *self._scope, *map(_own, key))).encode()
        # 63 bits: the range that torch accepts on every device.
        return int.from_bytes(hashlib.blake2b(address, digest_size=8).digest(), "little") >> 1


def _own(key: str | int) -> str | int:
    """Converts a key to a Python type, because NumPy's types have other representations."""
    return str(key) if isinstance(key, str) else index(key)
