"""Episodes of arena environments, played to their ends by scripted policies."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs.utils import check_env_specs

from proposer_rl.tasks.batched_envs import BatchedEnv


def levels(seeds: int | None = None, **parameters: Any) -> TensorDict:
    """Levels [B] of columns of numbers; of so many seeds, a parameter may have one number."""
    entries = {name: torch.as_tensor(value) for name, value in parameters.items()}
    if seeds is not None:
        entries = {name: value.expand(seeds) for name, value in entries.items()}
        entries["seed"] = torch.arange(seeds)
    return TensorDict(entries, [len(next(iter(entries.values())))])


def played(
    kind: type[BatchedEnv], given: TensorDict, steps: int, act: Callable[[Any], Tensor]
) -> Mapping[str, Tensor]:
    """What :func:`episodes` gives of levels [B] and a step limit."""
    return episodes(kind(given, max_steps=steps), act)


def play(env: BatchedEnv, act: Callable[[Any], Tensor]) -> tuple[Tensor, Tensor]:
    """Return and success [B] of :func:`episodes` where TorchRL finds nothing wrong."""
    check_env_specs(env)
    ends = episodes(env, act)
    return ends["return"], ends["success"]


def episodes(env: BatchedEnv, act: Callable[[Any], Tensor]) -> Mapping[str, Tensor]:
    """The success, return and steps [B] of an episode each, with the places [B, T, S]."""
    state, (count,) = env.reset(), env.batch_size
    going, total, length = (torch.ones(count) * begin for begin in (1, 0, 0))
    success, places = torch.zeros(count, dtype=torch.bool), []
    for _ in range(env.max_steps):
        state = env.step(state.set("action", act(state)))["next"]
        total, length = total + going * state["reward"].squeeze(-1), length + going
        success |= state["success"].squeeze(-1) & going.bool()
        going = going * ~state["done"].squeeze(-1)
        places.append(state["state"])
        state = state.exclude("reward")
    assert not going.any()
    return {"success": success, "return": total, "steps": length, "places": torch.stack(places, 1)}


def follow_minigrid(
    env: BatchedEnv, state: TensorDict, twins: Sequence[Any], choose: Callable[[list[bool]], Any]
) -> set[int]:
    """Play MiniGrid's own environments beside ours: views, rewards and ends must be the same.

    Returns which of them have reached the goal; ``choose`` gives each an action, [B].
    """

    def same_view(state: TensorDict, index: int, seen: dict[str, Any]) -> bool:
        view = state["observation"][index].reshape(7, 7, 3).transpose(0, 1)
        return bool((view.int().numpy() == seen["image"]).all())

    assert all(same_view(state, i, one.gen_obs()) for i, one in enumerate(twins))
    over, reached = [False] * len(twins), set()
    for _ in range(env.max_steps):
        actions = choose(over)
        after = env.step(state.set("action", torch.from_numpy(actions)))["next"]
        for index, other in enumerate(twins):
            if over[index]:
                continue
            seen, reward, ended, late, _ = other.step(int(actions[index]))
            assert same_view(after, index, seen)
            assert float(after["reward"][index]) == pytest.approx(reward)
            assert [bool(after[end][index]) for end in ("success", "terminated")] == [ended] * 2
            over[index] = ended or late
            assert bool(after["done"][index]) == over[index]
            reached |= {index} if ended else set()
        state = after.exclude("reward")
    assert all(over)
    return reached
