"""Episodes played to their ends by a scripted policy."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from proposer_rl.tasks.batched_envs.env import BatchedEnv


def levels(seeds: int, **parameters: Any) -> TensorDict:
    """Levels [seeds] that differ in nothing but their seeds, or in what is a list."""
    entries = {name: torch.as_tensor(value).expand(seeds) for name, value in parameters.items()}
    return TensorDict({**entries, "seed": torch.arange(seeds)}, [seeds])


def played(
    kind: type[BatchedEnv], given: TensorDict, steps: int, act: Callable[[Any], Tensor]
) -> Mapping[str, Tensor]:
    """The success, return and steps [B] of an episode each, with the places [B, steps, S]."""
    env = kind(given, max_steps=steps)
    state = env.reset()
    going, total, length = (torch.ones(len(given)) * begin for begin in (1, 0, 0))
    success, places = torch.zeros(len(given), dtype=torch.bool), []
    for _ in range(steps):
        state = env.step(state.set("action", act(state)))["next"]
        total, length = total + going * state["reward"].squeeze(-1), length + going
        success |= state["success"].squeeze(-1) & going.bool()
        going = going * ~state["done"].squeeze(-1)
        places.append(state["state"])
        state = state.exclude("reward")
    return {"success": success, "return": total, "steps": length, "places": torch.stack(places, 1)}
