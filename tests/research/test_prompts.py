"""The study of curricula of prompts: its models against plain ones, its grades against texts."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn import functional as F

from research import prompts
from research.prompt_tables import first_reached, page, read
from research.prompts import BetaPosterior, Setting
from research.tiny_lm import (
    ANSWERED,
    ASKED,
    CELLS,
    END,
    SIGNS,
    Adam,
    Sizes,
    Stack,
    encoded,
    graded,
    problem,
    to_end,
)
from tests.committed import RESULTS, needs_results

PUBLISHED = RESULTS / "prompts"
TINY = Setting(prompts=3, held_out=2, batch=4, group=3, rounds=4, every=2, warm=2, examples=4)
SIZES = Sizes(2, 16, 2)


def solved(prompt: str) -> str:
    """The right answer, from the prompt alone."""
    kind, digits = prompt[0], prompt[1:-1]
    if kind == "R":
        return digits[::-1]
    if kind == "S":
        return "".join(sorted(digits))
    if kind == "M":
        return "".join(str((int(one) + int(digits[0])) % 10) for one in digits[1:])
    return str(eval(prompt[:-1]))[::-1]


def test_answers_are_right_and_graded_as_their_texts_are() -> None:
    generator = np.random.default_rng(0)
    made = [problem(*cell, generator) for cell in CELLS for _ in range(20)]
    assert all(answer == solved(prompt) for prompt, answer in made)
    _, right = encoded(made)
    said = right[:, None].repeat(1, 8, 1)
    changed = torch.rand(said.shape, generator=torch.Generator().manual_seed(0)) < 0.1
    said = torch.where(changed, said.roll(1, -1), said)
    text = [["".join(SIGNS[sign] for sign in one) for one in group] for group in said.tolist()]
    for (_, answer), group, won, ends in zip(
        made, text, graded(said, right[:, None]), to_end(said), strict=True
    ):
        assert won.tolist() == [one.startswith(f"{answer}.") for one in group]
        assert ends.sum(-1).tolist() == [len(one.partition(".")[0]) + ("." in one) for one in group]


def plain(parameters: dict[str, Tensor], signs: list[int], heads: int) -> Tensor:
    """Log probabilities after each sign of one text, of one model: without stacks and caches."""
    start, width = ASKED - signs.index(-1), parameters["head"].shape[0]
    text = [sign for sign in signs if sign >= 0]
    x = torch.stack(
        [parameters["token"][one] + parameters["place"][start + i] for i, one in enumerate(text)]
    )
    for layer in range(2):
        q, k, v = (F.rms_norm(x, [width], eps=1e-6) @ parameters[f"attend{layer}"]).chunk(3, 1)
        parts = []
        for head in range(heads):
            own = slice(head * width // heads, (head + 1) * width // heads)
            scores = q[:, own] @ k[:, own].T / math.sqrt(width / heads)
            scores = scores.masked_fill(torch.ones_like(scores).triu(1) > 0, -torch.inf)
            parts.append(scores.softmax(1) @ v[:, own])
        x = x + torch.cat(parts, 1) @ parameters[f"mix{layer}"]
        x = (
            x
            + (F.rms_norm(x, [width], eps=1e-6) @ parameters[f"up{layer}"]).relu()
            @ (parameters[f"down{layer}"])
        )
    return (F.rms_norm(x, [width], eps=1e-6) @ parameters["head"]).log_softmax(1)


def test_a_step_of_a_stack_is_that_of_plain_models_one_by_one() -> None:
    """GRPO's step, on other numbers of groups; whoever has no group stays as it is."""
    seeds, generator = (3, 4, 5), np.random.default_rng(1)
    stack = Stack(seeds, SIZES)
    before = {name: one.detach().clone() for name, one in stack.parameters.items()}
    made = encoded([problem(*cell, generator) for cell in CELLS])
    asked, right = (one.expand(len(seeds), -1, -1) for one in made)
    draws = torch.rand(3, len(CELLS), 3, ANSWERED, generator=torch.Generator().manual_seed(0))
    said = stack.answer(asked, 3, draws)
    said[:, :, 0] = right  # else none would be right
    won = graded(said, right.unsqueeze(2)).float()
    groups = [
        [(torch.tensor(i), said[k, i], won[k, i]) for i in range(2, 2 + count)]
        for k, count in enumerate((3, 0, 1))
    ]
    prompts.step(stack, Adam(stack, 0.01), asked, groups, TINY)
    for k, own in enumerate(groups):
        alone = {name: one[k].clone().requires_grad_() for name, one in before.items()}
        optimizer = torch.optim.Adam(alone.values(), 0.01, (0.9, 0.99))
        losses = []
        for item, answers, marks in own:
            for answer, mark in zip(answers, marks, strict=True):
                prompt = [one for one in made[0][item].tolist() if one]
                end = answer.tolist().index(END) + 1 if END in answer else ANSWERED
                text = prompt + answer.tolist()[:end]
                signs = torch.tensor(text)
                found = plain(alone, [*prompt, -1, *text[len(prompt) :]], SIZES.heads)
                after = torch.arange(len(prompt), len(text))
                chance = found[after - 1, signs[after]].sum()
                losses.append(-chance * (mark - marks.mean()) / (marks.std() + 1e-4))
        if losses:
            loss = torch.stack(losses).sum() / (TINY.batch * TINY.group * ANSWERED)
            loss.backward()
            torch.nn.utils.clip_grad_norm_([*alone.values()], 1.0)
            optimizer.step()
        for name, one in alone.items():
            torch.testing.assert_close(
                stack.parameters[name][k].detach(), one.detach(), atol=2e-4, rtol=1e-3
            )


def test_pass_rates_are_how_often_random_answers_are_right() -> None:
    stack, generator = Stack([0], SIZES), np.random.default_rng(0)
    asked, right = encoded([problem("shift", 1, generator) for _ in range(4)])
    adam, one = Adam(stack, 0.01), torch.ones(1, dtype=torch.bool)
    for _ in range(60):
        found = stack.log_probabilities(asked[None], right[None, :, None])[:, :, 0]
        adam.step(-(found * to_end(right)).sum((1, 2)), one)
        rates = stack.pass_rates(asked[None], right[None])[0]
        if rates.mean() > 0.4:
            break
    draws = torch.rand(1, 4, 2000, ANSWERED, generator=torch.Generator().manual_seed(0))
    often = graded(stack.answer(asked[None], 2000, draws), right[None, :, None]).float().mean(2)[0]
    assert 0.1 < rates.mean() < 0.9
    assert (often - rates).abs().max() < 5 * 0.5 / math.sqrt(2000)


def test_a_beta_posterior_fades_where_it_is_visited() -> None:
    beta = BetaPosterior(2, 0.5)
    beta.observe(np.array([0, 0]), np.array([0.75, 0.25]), 4)
    # 1 + 3 and 1 + 1; then half of what is over the prior of 1, with 1 and 3 more.
    assert beta.predict(np.array([0, 1])).tolist() == pytest.approx([3.5 / 8, 0.5])


def test_a_goal_is_reached_on_the_line_between_evaluations() -> None:
    rollouts = np.array([0.0, 10.0, 20.0])
    for rates, goal, share in (
        ([0.1, 0.3, 0.2], 0.2, 0.25),
        ([0.1, 0.1, 0.2], 0.2, 1.0),
        ([0.1, 0.1, 0.1], 0.2, 1.0),
        ([0.3, 0.1, 0.1], 0.2, 0.0),
    ):
        assert first_reached(rollouts, np.array(rates), goal) == pytest.approx(share)


def test_a_study_goes_on_where_it_was_and_refuses_another_setting(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    changed = '{"prompts":3,"held_out":2,"batch":4,"group":3,"rounds":4,"every":2,"warm":2}'
    arms = [prompts.UNIFORM, prompts.DYNAMIC, prompts.OURS, f"{prompts.UNIFORM}{prompts.TRAP}"]
    given = ["--folder", str(tmp_path), "--seeds", "0-1", "--set", changed, "--arms", *arms]
    prompts.main(given)
    page = (tmp_path / "README.md").read_text()
    assert all(arm in page.replace("\\", "") for arm in arms)
    first = prompts.results_in(tmp_path, arms)
    (tmp_path / "uniform_1.json").unlink()
    setting = prompts.read_setting(changed)
    prompts.study(tmp_path, arms, [0, 1], setting, "cpu")
    again = prompts.results_in(tmp_path, arms)
    assert [one["arm"] for one in again] == [one for one in arms for _ in range(2)]
    for one, other in zip(first, again, strict=True):
        assert one["drawn"] == other["drawn"] and sum(one["drawn"]) == 4 * 4
        np.testing.assert_allclose(one["passed"], other["passed"], atol=2e-4)
    capsys.readouterr()
    with pytest.raises(SystemExit) as end:
        prompts.main([*given[:5], '{"rounds": 5}'])
    assert end.value.code == 2 and "another setting: prompts" in capsys.readouterr().err


@needs_results
def test_the_page_follows_from_its_tables() -> None:
    assert page(read(PUBLISHED), **prompts.NAMES) in (PUBLISHED / "README.md").read_text("utf-8")
