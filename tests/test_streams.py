from __future__ import annotations

import numpy as np
import torch

from proposer_rl.streams import Streams
from tests.tiny import TASK


def numbers(generator: torch.Generator) -> list[float]:
    return torch.rand(3, generator=generator).tolist()


def test_equal_keys_give_equal_numbers_and_others_do_not() -> None:
    keys = [("a", 1), ("a", 2), ("b", 1), ("a", 1, 0), ("a1",), ("a", "1")]
    draws = {key: numbers(Streams(0).generator(*key)) for key in keys}
    assert len(set(map(tuple, draws.values()))) == len(keys)
    assert numbers(Streams(0).generator("a", 1)) == draws["a", 1]
    assert numbers(Streams(1).generator("a", 1)) != draws["a", 1]


def test_keys_of_numpy_are_those_of_python() -> None:
    foreign = Streams(np.int64(5), np.str_("cycle")).generator(np.int32(3), torch.tensor(1))
    assert numbers(foreign) == numbers(Streams(5).generator("cycle", 3, 1))


def test_a_scope_is_part_of_the_key() -> None:
    scoped = Streams(5).within("cycle", 3)
    assert numbers(scoped.generator("x")) == numbers(Streams(5).generator("cycle", 3, "x"))
    assert scoped.address == [5, "cycle", 3]
    assert numbers(Streams(*scoped.address).generator("x")) == numbers(scoped.generator("x"))


def test_code_without_a_generator_draws_from_the_stream_inside_only() -> None:
    torch.manual_seed(0)
    expected = torch.rand(2)
    torch.manual_seed(0)
    with Streams(1).as_default("weights"):
        inside = torch.rand(3)
    assert torch.equal(torch.rand(2), expected)
    with Streams(1).as_default("weights"):
        assert torch.equal(torch.rand(3), inside)


def test_the_generators_of_gpus_are_left_alone(monkeypatch) -> None:
    def seeded(seed: int) -> None:
        raise AssertionError("a GPU's generator was seeded")

    monkeypatch.setattr(torch.cuda, "manual_seed_all", seeded)
    with Streams(1).as_default("weights"):
        torch.rand(1)


def test_each_network_has_the_weights_of_its_own_stream() -> None:
    together = TASK.learner([Streams(1), Streams(2)]).agent
    for copy, seed in enumerate((1, 2)):
        alone = TASK.learner([Streams(seed)]).agent
        for both, one in zip(together.parameters(), alone.parameters(), strict=True):
            assert torch.equal(both[copy], one[0])
    assert not torch.equal(*next(together.parameters()))
