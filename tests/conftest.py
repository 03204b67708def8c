from __future__ import annotations

import os

# Before anything imports pyplot: tests draw into files, also where there is no display.
os.environ.setdefault("MPLBACKEND", "Agg")

import hypothesis
import pytest
import torch

# A busy machine makes an example slow, not wrong.
hypothesis.settings.register_profile("proposer_rl", deadline=None)
hypothesis.settings.load_profile("proposer_rl")


# Tensors in tests are too small for threads to pay, and tests share the machine.
torch.set_num_threads(1)


@pytest.fixture(autouse=True)
def _seeded() -> None:
    """TorchRL's distributions draw from the global generator."""
    torch.manual_seed(0)
