"""Words and goals that are numbered: what is solvable, and what numbers and features tell."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import torch
import yaml
from tensordict import TensorDict
from torchrl.envs import check_env_specs

from proposer_rl.cli.build import make_task
from proposer_rl.streams import Streams
from proposer_rl.tasks.arena.items import ITEMS, SYMBOLS, BlindItemsEnv, PairsEnv
from tests.tasks.arena.episodes import levels, play, played
from tests.tiny import composed

ALL = TensorDict({"item": torch.arange(ITEMS)}, [ITEMS])


def tried(answers: list[int]) -> Mapping[str, torch.Tensor]:
    """What comes of each word, with an answer for each symbol."""
    table = torch.tensor(answers)
    seen = lambda state: state["observation"][:, :SYMBOLS].argmax(-1)  # noqa: E731
    return played(BlindItemsEnv, ALL, 17, lambda state: table[seen(state)])


def solution() -> list[int]:
    """The answer of each symbol, from words that begin with it: a wrong one is their end."""
    answers = [-1] * SYMBOLS
    for answer in range(4):
        state = (env := BlindItemsEnv(ALL)).reset()
        first = state["observation"][:, :SYMBOLS].argmax(-1)
        after = env.step(state.set("action", torch.full((ITEMS,), answer)))["next"]
        right = (~after["terminated"] | after["success"]).squeeze(-1)
        for symbol in first[right].unique().tolist():
            assert right[first == symbol].all() and answers[symbol] == -1
            answers[symbol] = answer
    return answers


def test_one_table_of_answers_solves_every_word_and_numbers_tell_nothing() -> None:
    result = tried(solution())
    assert result["success"].all() and (result["return"] == 1).all()
    length = result["steps"]
    assert set(length.tolist()) == set(range(1, 18))
    assert abs(float(torch.corrcoef(torch.stack([length, torch.arange(200.0)]))[0, 1])) < 0.15
    text = Path("conf/task/arena/blind_items.yaml").read_text()
    said = yaml.safe_load(text)["task"]["parameters"]["item"]
    assert said["values"] == list(range(ITEMS)) and len(set(said["target"])) == 20
    assert length[said["target"]].min() > length.median()


def test_a_wrong_answer_ends_a_word_with_nothing() -> None:
    answers = solution()
    result = tried([(answer + 1) % 4 for answer in answers])
    assert (result["steps"] == 1).all() and not result["success"].any()
    check_env_specs(BlindItemsEnv(ALL[:3]), break_when_any_done="both")


GOALS = levels(item=torch.arange(ITEMS))


def test_each_item_is_solvable_and_its_features_tell_its_goal() -> None:
    env = PairsEnv(GOALS, max_steps=40)
    goals = 4 * env.reset()["observation"][..., 2:4]
    assert play(env, lambda now: now["observation"][..., 2:4] * 4)[1].all()
    known = PairsEnv.features(dict(GOALS.items()))
    assert known.abs().max() <= 1
    torch.testing.assert_close(2 * known[:, 0] + 2, goals.norm(dim=-1))
    torch.testing.assert_close(4 * known[:, 1:3], goals)


def test_the_target_are_the_farthest_and_features_are_added_to_the_space_s() -> None:
    task = make_task(composed("task=arena/pairs", "+method=target"))
    far = PairsEnv(GOALS, max_steps=40).reset()["observation"][..., :2].norm(dim=-1)
    drawn = task.target.sample(400, Streams(0).generator())
    assert sorted(set(drawn["item"].tolist())) == sorted(far.topk(20).indices.tolist())
    given = task.features(drawn.view(2, 200))
    assert given.shape == (2, 200, 3 + ITEMS + 5)
    torch.testing.assert_close(
        given[..., -5:].float(), PairsEnv.features(dict(drawn.view(2, 200).items()))
    )
