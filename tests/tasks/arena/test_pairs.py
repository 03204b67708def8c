"""Two hundred goals: the features are theirs, and a model of outcomes gets them."""

from __future__ import annotations

import torch

from proposer_rl.cli.build import make_task
from proposer_rl.streams import Streams
from proposer_rl.tasks.arena.items import ITEMS, PairsEnv
from tests.tasks.arena.episodes import levels, play
from tests.tiny import composed

ALL = levels(item=torch.arange(ITEMS))


def test_each_item_is_solvable_and_its_features_tell_its_goal() -> None:
    env = PairsEnv(ALL, max_steps=40)
    goals = 4 * env.reset()["observation"][..., 2:4]
    assert play(env, lambda now: now["observation"][..., 2:4] * 4)[1].all()
    known = PairsEnv.features(dict(ALL.items()))
    assert known.abs().max() <= 1
    torch.testing.assert_close(2 * known[:, 0] + 2, goals.norm(dim=-1))
    torch.testing.assert_close(4 * known[:, 1:3], goals)


def test_the_target_are_the_farthest_and_features_are_added_to_the_space_s() -> None:
    task = make_task(composed("task=arena/pairs", "+method=target"))
    far = PairsEnv(ALL, max_steps=40).reset()["observation"][..., :2].norm(dim=-1)
    drawn = task.target.sample(400, Streams(0).generator())
    assert sorted(set(drawn["item"].tolist())) == sorted(far.topk(20).indices.tolist())
    given = task.features(drawn.view(2, 200))
    assert given.shape == (2, 200, 3 + ITEMS + 5)
    torch.testing.assert_close(
        given[..., -5:].float(), PairsEnv.features(dict(drawn.view(2, 200).items()))
    )
