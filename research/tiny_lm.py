"""Tiny language models, a stack of which is trained side by side, and prompts made in code.

Four families of prompts over digits, each with four levels, n = 1 to 4:

- ``add``: sums of two numbers of n digits, the last digit of the sum first;
- ``reverse``: n + 2 digits, to be written backwards;
- ``sort``: n + 2 digits, to be written in rising order;
- ``shift``: a digit k and n + 1 others, to each of which k is to be added modulo 10.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

SIGNS = "_.0123456789+=RSM"  # _ fills up on the left, . ends an answer
PAD, END = 0, 1
CODES = {sign: code for code, sign in enumerate(SIGNS)}
ASKED, ANSWERED = 10, 7  # signs of a prompt and of an answer at most
FAMILIES = ("add", "reverse", "sort", "shift")
LEVELS = 4
CELLS = [(family, level) for family in FAMILIES for level in range(1, LEVELS + 1)]

BETAS = 0.9, 0.99  # of Adam

Cache = list[tuple[Tensor, Tensor]]


def problem(family: str, level: int, generator: np.random.Generator) -> tuple[str, str]:
    """Returns a random prompt of a family and a level, 1 to 4, and the right answer to it."""
    if family == "add":
        a, b = generator.integers(10 ** (level - 1) * (level > 1), 10**level, 2).tolist()
        return f"{a}+{b}=", str(a + b)[::-1]
    digits = generator.integers(0, 10, level + 2).tolist()
    if family == "reverse":
        return f"R{_text(digits)}=", _text(digits[::-1])
    if family == "sort":
        return f"S{_text(digits)}=", _text(sorted(digits))
    return f"M{_text(digits)}=", _text([(digit + digits[0]) % 10 for digit in digits[1:]])


def encoded(problems: Sequence[tuple[str, str]]) -> tuple[Tensor, Tensor]:
    """Returns prompts int64 [n, ASKED], filled up on the left, and answers [n, ANSWERED]."""
    asked = [prompt.rjust(ASKED, SIGNS[PAD]) for prompt, _ in problems]
    right = [f"{answer}{SIGNS[END]}".ljust(ANSWERED, SIGNS[PAD]) for _, answer in problems]
    codes = ([[CODES[sign] for sign in text] for text in texts] for texts in (asked, right))
    prompts, answers = map(torch.tensor, codes)
    return prompts, answers


def graded(said: Tensor, right: Tensor) -> Tensor:
    """Returns which answers [..., ANSWERED] are the right ones up to their end, bool [...]."""
    return ((said == right) | (right == PAD)).all(-1)


def to_end(said: Tensor) -> Tensor:
    """Returns which signs of answers [..., T] count: those up to the first end, bool [..., T]."""
    ended = (said == END).cumsum(-1)
    return (ended == 0) | ((ended == 1) & (said == END))


class Sizes(NamedTuple):
    """Layers, width and heads of a transformer."""

    layers: int = 2
    width: int = 64
    heads: int = 4


class Stack:
    """S transformers side by side, each with parameters of its own.

    Without biases; RMS norm before each part (Zhang and Sennrich 2019), ReLU between; positions
    count from the left, and prompts end at one place.

    Args:
        seeds: of the initial parameters, S of them.
        sizes: of each.
        device: of the parameters.
    """

    def __init__(
        self, seeds: Sequence[int], sizes: Sizes | None = None, device: str = "cpu"
    ) -> None:
        self.sizes = sizes or Sizes()
        layers, width, _ = self.sizes
        thin = 1 / math.sqrt(width)
        shapes = {"token": (len(SIGNS), width, 0.5), "place": (ASKED + ANSWERED, width, 0.5)}
        for layer in range(layers):
            shapes[f"attend{layer}"] = (width, 3 * width, thin)
            shapes[f"mix{layer}"] = (width, width, thin / math.sqrt(2 * layers))
            shapes[f"up{layer}"] = (width, 4 * width, thin)
            shapes[f"down{layer}"] = (4 * width, width, thin / 2 / math.sqrt(2 * layers))
        shapes["head"] = (width, len(SIGNS), thin)
        generators = [torch.Generator().manual_seed(seed) for seed in seeds]
        self.parameters = {
            name: torch.stack([deviation * torch.randn(*shape, generator=g) for g in generators])
            .to(device)
            .requires_grad_()
            for name, (*shape, deviation) in shapes.items()
        }

    def forward(
        self, tokens: Tensor, past: Cache | None = None, padded: Tensor | None = None
    ) -> tuple[Tensor, Cache]:
        """Returns log probabilities of the next sign after each, and what later ones attend to.

        Args:
            tokens: int64 [S, n, T].
            past: keys and values of the signs before them, [S n, heads, P, D] for each layer.
            padded: which of all P + T signs are none, bool [S, n, P + T].
        """
        students, count, length = tokens.shape
        heads, width = self.sizes.heads, self.sizes.width
        before = past[0][0].shape[2] if past else 0
        own = self.parameters
        rows = torch.arange(students, device=tokens.device)[:, None, None] * len(SIGNS)
        x = F.embedding(tokens + rows, own["token"].flatten(0, 1))
        x = x + own["place"][:, None, before : before + length]
        x = x.flatten(1, 2)
        allowed = torch.ones(length, before + length, dtype=torch.bool, device=x.device)
        allowed = allowed.tril(before)
        if padded is not None:
            itself = torch.eye(before + length, dtype=torch.bool, device=x.device)[before:]
            allowed = (allowed & ~padded.reshape(-1, 1, 1, before + length)) | itself
        present: Cache = []
        for layer in range(self.sizes.layers):
            made = (_normed(x) @ own[f"attend{layer}"]).view(students * count, length, 3, heads, -1)
            query, key, value = made.permute(2, 0, 3, 1, 4)
            if past:
                key, value = (
                    torch.cat(two, 2) for two in zip(past[layer], (key, value), strict=True)
                )
            present.append((key, value))
            seen = F.scaled_dot_product_attention(query, key, value, allowed)
            seen = seen.transpose(1, 2).reshape(students, count * length, width)
            x = x + seen @ own[f"mix{layer}"]
            x = x + (_normed(x) @ own[f"up{layer}"]).relu() @ own[f"down{layer}"]
        logits = _normed(x) @ own["head"]
        return logits.log_softmax(-1).view(students, count, length, -1), present

    def log_probabilities(self, prompts: Tensor, answers: Tensor) -> Tensor:
        """Returns the log probability of each sign of G answers to each prompt.

        Args:
            prompts: int64 [S, n, ASKED].
            answers: int64 [S, n, G, ANSWERED].

        Returns:
            Float [S, n, G, ANSWERED]; whatever follows an end counts, too.
        """
        students, count, group, _ = answers.shape
        first, cache, padded = self._asked(prompts, group)
        told = answers.flatten(1, 2)
        later, _ = self.forward(told[..., :-1], cache, F.pad(padded, (0, ANSWERED - 1)))
        every = torch.cat([first, later], 2).view(students, count, group, ANSWERED, -1)
        return every.gather(-1, answers.unsqueeze(-1)).squeeze(-1)

    @torch.no_grad()
    def answer(self, prompts: Tensor, group: int, draws: Tensor) -> Tensor:
        """Returns G random answers to each prompt, int64 [S, n, G, ANSWERED].

        Args:
            prompts: int64 [S, n, ASKED].
            group: number G.
            draws: uniform numbers that choose the signs, [S, n, G, ANSWERED].
        """
        students, count, _ = prompts.shape
        last, cache, padded = self._asked(prompts, group)
        draws = draws.flatten(1, 2)
        said: list[Tensor] = []
        for place in range(ANSWERED):
            rising = last[:, :, -1].exp().cumsum(-1)
            chosen = torch.searchsorted(rising, draws[..., place : place + 1] * rising[..., -1:])
            said.append(chosen.clamp(max=len(SIGNS) - 1))
            if place + 1 < ANSWERED:
                padded = F.pad(padded, (0, 1))
                last, cache = self.forward(said[-1], cache, padded)
        return torch.cat(said, -1).view(students, count, group, ANSWERED)

    @torch.no_grad()
    def pass_rates(self, prompts: Tensor, right: Tensor) -> Tensor:
        """Returns the exact probability of the right answer [S, n, ANSWERED] to prompts, [S, n]."""
        found = self.log_probabilities(prompts, right.unsqueeze(2)).squeeze(2)
        return (found * to_end(right)).sum(-1).exp()

    def _asked(self, prompts: Tensor, group: int) -> tuple[Tensor, Cache, Tensor]:
        """Reads prompts once for the G answers to each; their last logits, cache and padding."""
        padded = prompts == PAD
        read, cache = self.forward(prompts, padded=padded)
        cache = [
            (key.repeat_interleave(group, 0), value.repeat_interleave(group, 0))
            for key, value in cache
        ]
        last, padded = (one.repeat_interleave(group, 1) for one in (read[:, :, -1:], padded))
        return last, cache, padded


class Adam:
    """Adam (Kingma and Ba 2015) of a stack, of which some may stay as they are in a step.

    Gradients are clipped to a norm of 1, each model's by itself.

    Args:
        stack: whose gradients it takes.
        rate: of learning.
    """

    def __init__(self, stack: Stack, rate: float) -> None:
        self._of, self.rate = stack.parameters, rate
        self._mean = {name: torch.zeros_like(one) for name, one in self._of.items()}
        self._square = {name: torch.zeros_like(one) for name, one in self._of.items()}
        some = next(iter(self._of.values()))
        self._steps = torch.zeros(len(some), 1, 1, device=some.device)

    def step(self, loss: Tensor, moving: Tensor) -> None:
        """Takes a step of those that are ``moving``, bool [S], down the losses [S]."""
        self._move(torch.autograd.grad(loss.sum(), list(self._of.values())), moving)

    @torch.no_grad()
    def _move(self, slopes: Sequence[Tensor], moving: Tensor) -> None:
        goes = moving.view(-1, 1, 1).float()
        self._steps += goes
        squares = torch.stack([slope.square().sum((1, 2), keepdim=True) for slope in slopes])
        short = (1 / (squares.sum(0).sqrt() + 1e-6)).clamp(max=1)
        first, second = BETAS
        steps = self._steps.clamp(min=1)
        for (name, one), slope in zip(self._of.items(), slopes, strict=True):
            slope = slope * short
            mean, square = self._mean[name], self._square[name]
            mean += goes * (1 - first) * (slope - mean)
            square += goes * (1 - second) * (slope.square() - square)
            height = (square / (1 - second**steps)).sqrt() + 1e-8
            one -= goes * self.rate / (1 - first**steps) * mean / height


def _normed(x: Tensor) -> Tensor:
    return x * (x.square().mean(-1, keepdim=True) + 1e-6).rsqrt()


def _text(digits: Sequence[int]) -> str:
    return "".join(map(str, digits))
