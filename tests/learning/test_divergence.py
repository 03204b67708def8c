"""A number that goes wrong is named, and does no harm to other copies."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from proposer_rl.learning import DivergedError, located
from proposer_rl.learning.objective import require_finite
from tests.draws import generators
from tests.learning.test_ppo import learner

K, S = 3, 2
BAD = [float("nan"), float("inf"), float("-inf")]


def healthy() -> tuple[torch.Tensor, TensorDict, dict[str, torch.Tensor]]:
    scalars = ("loss_objective", "loss_entropy", "loss_critic", "loss_own", "grad_norm")
    steps = TensorDict({name: torch.randn(S, K) for name in scalars}, [S])
    steps["kl_approx"] = torch.full((S,), float("inf"))  # a diagnostic, of no effect
    return torch.randn(K, 4, 5, 1), steps, {"a": torch.randn(K, 2), "b": torch.randn(K, 3, 3)}


def test_finite_numbers_pass_however_large() -> None:
    reward, steps, weights = healthy()
    require_finite(reward, steps, weights, K)
    # The sum of these overflows, they do not.
    require_finite(reward, steps, {"a": torch.full((K, 100), 3e38)}, K)


@pytest.mark.parametrize("bad", BAD)
@pytest.mark.parametrize("copy", range(K))
def test_the_copy_and_what_went_wrong_first_are_named(bad: float, copy: int) -> None:
    """Also among copies that others hold some of, in several at once, and without any."""
    reward, steps, weights = healthy()
    weights["b"][copy, 1, 2] = bad

    def told(match: str, **how: int) -> None:
        with pytest.raises(DivergedError, match=f"^{match}"):
            require_finite(reward, steps, weights, K, **how)

    told(rf"copy {copy}: weight b is not finite \({bad}\)$")
    told(rf"copy {4 + copy}: weight b", first=4)
    with pytest.raises(DivergedError, match=r"^weight b is not finite"):
        require_finite(reward, steps[:, None][..., 0], weights, None)
    for name, step in ("grad_norm", 1), ("loss_own", 1), ("grad_norm", 0):
        steps[name][step, copy] = bad
        told(f"copy {copy}: {name} of gradient step {step} is")
    reward[copy, 2, 3] = bad
    told(f"copy {copy}: reward is not finite")
    reward[:, 2, 3] = bad
    told("copy 0, 1, 2: reward")


def test_says_where_from_the_outside_in() -> None:
    with (
        pytest.raises(DivergedError, match=r"^cycle 3: step 2: reward$"),
        located("cycle 3"),
        located("step 2"),
    ):
        raise DivergedError("reward")


@pytest.mark.parametrize("bad", BAD)
@pytest.mark.parametrize("what", ["loss", "reward"])
def test_a_copy_that_diverges_is_caught_in_its_update_and_leaves_the_others_alone(
    bad: float, what: str
) -> None:
    clean, poisoned = learner(copies=3), learner(copies=3)
    rollouts = [ppo.collect(generators(0, 1, 2)) for ppo in (clean, poisoned)]
    if what == "reward":
        rollouts[1]["next", "reward"][1, 0, 4] = bad
    else:
        next(poisoned.agent.parameters()).data[1].view(-1)[0] = bad
    clean.optimise(rollouts[0])
    clean.check()
    with pytest.raises(DivergedError, match=f"^copy 1: {what}"):
        poisoned.optimise(rollouts[1])
        poisoned.check()
    others = clean.snapshot()[[0, 2]], poisoned.snapshot()[[0, 2]]
    assert (others[0] == others[1]).all()
    assert not poisoned.snapshot()[1].isfinite().all()
