"""Goals of which half are out of reach, by the best push."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase

from proposer_rl.cli.build import make_task
from proposer_rl.streams import Streams
from tests.tasks.arena.episodes import play
from tests.tiny import composed


def test_about_half_of_the_target_is_possible_and_the_far_end_is_not() -> None:
    task = make_task(composed("task=arena/half", "+method=target"))
    drawn = task.target.sample(600, Streams(0).generator())
    env = task.environment(drawn)

    def push(now: TensorDictBase) -> torch.Tensor:
        apart = now["observation"][..., 2:4]
        return apart / apart.abs().amax(-1, keepdim=True)

    _, success = play(env, push)
    assert 0.4 < float(success.float().mean()) < 0.55
    speed = place = 0.0
    for _ in range(25):
        speed = 0.8 * speed + 0.03
        place += speed
    goals = drawn["distance"] * (torch.pi * drawn["direction"]).cos()  # along the fastest axis
    assert not success[goals > place + 0.3].any()
    assert success[drawn["distance"] < place + 0.2].all()
