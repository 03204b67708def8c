"""The trap: a family of prompts whose answers all fail for a while by a fault, and then do not.

Whoever draws by what was seen alone leaves it, and never learns that it is well again: drawing the
most learnable prompts ends below 0.9 of uniform draws here.
"""

from __future__ import annotations

from typing import Any

import torch

import proposer_rl as prl

FAMILIES, EACH, PROMPTS, ANSWERS = 4, 60, 16, 8
FAULT, END = 30, 80  # batches
FASTER = 0.035


def passes(recipe: Any, seed: int) -> float:
    """Returns the pass rate of the family that had the fault, in the end.

    The learner is a skill of each family, which grows by how much the answers of a group differ.
    """
    draw = torch.Generator().manual_seed(seed)
    family = torch.arange(FAMILIES * EACH) % FAMILIES
    difficulty = 2.5 * torch.randn(len(family), generator=draw)
    noisy = (difficulty + torch.randn(len(family), generator=draw)).tolist()
    features = {"source": ["abcd"[one] for one in family], "length": noisy}
    teacher = prl.Teacher(recipe, prl.Items(len(family), features=features), seed=seed)
    skill = torch.full((FAMILIES,), -1.5)
    for batch in range(END):
        p = (skill[family] - difficulty).sigmoid()
        if batch < FAULT:
            p = p.where(family > 0, 0.0)
        items = teacher.propose(PROMPTS)
        success = torch.bernoulli(p[items].expand(ANSWERS, -1), generator=draw).mean(0)
        gains = (success * (1 - success)).sqrt()
        skill = skill.index_add(0, family[items], FASTER * gains)
        number = torch.full_like(success, ANSWERS)
        teacher.observe({"return": success, "success": success, "episodes": number})
    return float((skill[0] - difficulty)[family == 0].sigmoid().mean())


def test_the_default_method_comes_back_to_a_family_that_had_a_fault() -> None:
    own, uniform = (
        sum(passes(name, seed) for seed in range(2))
        for name in (prl.DEFAULT_METHOD, "domain_randomization")
    )
    assert own > 0.95 * uniform
