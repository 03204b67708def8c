"""Adam with its state made in advance is Adam."""

from __future__ import annotations

import torch
from torch import nn

from proposer_rl.learning.ppo import complete_adam


def test_state_made_in_advance_changes_no_step() -> None:
    generator = torch.Generator().manual_seed(0)
    parameters = [[nn.Parameter(torch.ones(3, 5)), nn.Parameter(torch.ones(7))] for _ in range(2)]
    early = complete_adam(parameters[0], 0.1, 1e-5)
    late = torch.optim.Adam(parameters[1], lr=0.1, eps=1e-5, fused=True)
    for _ in range(5):
        slope = torch.randn(3, 5, generator=generator)
        for (used, _), adam in zip(parameters, (early, late), strict=True):
            used.grad = slope.clone()
            adam.step()
    for one, other in zip(*parameters, strict=True):
        assert torch.equal(one, other)
    used, unused = parameters[0]
    assert early.state[used]["step"] == 5 and early.state[unused]["step"] == 0
    assert not torch.equal(used, torch.ones(3, 5)) and torch.equal(unused, torch.ones(7))
