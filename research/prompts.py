"""Curricula of prompts: tiny language models, trained from scratch by GRPO at equal rollouts.

All seeds of an arm are trained side by side. What has been finished stays in the folder, one JSON
file for each arm and seed, and is not run again.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

import proposer_rl as prl
from proposer_rl.cli.errors import ConfigError, command, say
from proposer_rl.curricula.belief import Belief
from proposer_rl.runs.folder import write_atomically
from research.prompt_tables import results_in, write
from research.tiny_lm import (
    ANSWERED,
    CELLS,
    FAMILIES,
    LEVELS,
    Adam,
    Stack,
    encoded,
    graded,
    problem,
    to_end,
)

TRAPPED = "shift"  # the family whose answers are graded wrong for a while
DECAYS = 0.5, 0.8, 0.95, 1.0  # of Beta posteriors at each visit; the first is MoPPS's


@dataclass(frozen=True)
class Arm:
    """A way to choose prompts.

    Attributes:
        method: the name of a curriculum.
        settings: that differ from its defaults.
        features: what it is told of families and levels: ``numbers``, families as categories and
            levels as numbers; ``texts``, a category for each level of each family; ``rates``, a
            guess of the pass rate by the level alone, for there is no other model; or nothing.
        target: the family that is to be mastered; None for all.
        refill: dynamic sampling (Yu et al. 2025): prompts are drawn until there are as many mixed
            groups as prompts of a round, and no others are trained on; what is over is lost.
        trap: whether a family is graded wrong in the first third.
    """

    method: str
    settings: Mapping[str, Any] = field(default_factory=dict)
    features: str = "numbers"
    target: str | None = None
    refill: bool = False
    trap: bool = False


UNIFORM, DYNAMIC, OURS = "uniform", "dynamic sampling", "adaptive_mixture"
METHODS = {
    UNIFORM: Arm("domain_randomization"),
    DYNAMIC: Arm("domain_randomization", refill=True),
    "mopps": Arm("mopps"),
    "adarft": Arm("adarft", features="rates"),
    "sec": Arm("sec", features="texts"),
    "arc_length": Arm("arc_length"),
    "plr": Arm("plr", {"score": "learnability", "temperature": 0.3}),
    OURS: Arm(OURS),
    f"{OURS}, no features": Arm(OURS, features=""),
    f"{OURS}, target add": Arm(OURS, target="add"),
}
TRAP = ", trap"
ARMS = METHODS | {
    f"{name}{TRAP}": replace(METHODS[name], trap=True)
    for name in (UNIFORM, DYNAMIC, "mopps", "sec", "arc_length", OURS)
}
NAMES = {"uniform": UNIFORM, "dynamic": DYNAMIC, "ours": OURS, "trap": TRAP, "trapped": TRAPPED}
LOOKED = UNIFORM, OURS  # arms whose prompts the predictors see


@dataclass(frozen=True)
class Setting:
    """How much of all there is.

    Attributes:
        prompts: for training, of each level of each family.
        held_out: likewise, for evaluation.
        batch: prompts of a round.
        group: answers to each.
        rounds: of training.
        every: rounds between evaluations.
        rate: of learning in GRPO.
        warm: steps of supervised learning before it, each of ``examples``.
        examples: of these.
        warm_rate: of learning there.
        families: shares of the examples, in the order of :data:`FAMILIES`.
        levels: likewise, of each level.
    """

    prompts: int = 64
    held_out: int = 24
    batch: int = 16
    group: int = 8
    rounds: int = 240
    every: int = 10
    rate: float = 5e-4
    warm: int = 750
    examples: int = 48
    warm_rate: float = 2e-3
    families: tuple[float, ...] = (0.45, 0.04, 0.06, 0.45)
    levels: tuple[float, ...] = (0.4, 0.3, 0.2, 0.1)


class Prompts:
    """Prompts of S students: for training [S, N, ...] and held out [S, M, ...], level by level."""

    def __init__(self, seeds: Sequence[int], setting: Setting) -> None:
        trained, kept, self.kept_texts = [], [], []
        for seed in seeds:
            generator = np.random.default_rng([seed, 0])
            every: list[list[tuple[str, str]]] = []
            for cell in CELLS:
                found: dict[str, str] = {}
                while len(found) < setting.prompts + setting.held_out:
                    found |= [problem(*cell, generator)]
                every.append([*found.items()])
            trained.append(encoded([one for cell in every for one in cell[: setting.prompts]]))
            kept.append(encoded([one for cell in every for one in cell[setting.prompts :]]))
            texts = {prompt for cell in every for prompt, _ in cell[setting.prompts :]}
            self.kept_texts.append(texts)
        self.asked, self.right = (torch.stack(one) for one in zip(*trained, strict=True))
        self.kept_asked, self.kept_right = (torch.stack(one) for one in zip(*kept, strict=True))
        self.cell = torch.arange(len(CELLS)).repeat_interleave(setting.prompts)
        of = [CELLS[cell] for cell in self.cell.tolist()]
        families, levels = (list(one) for one in zip(*of, strict=True))
        rates = [1 - level / (LEVELS + 1) for level in levels]
        self.known: dict[str, dict[str, Any]] = {
            "numbers": {"features": {"family": families, "level": levels}},
            "texts": {"features": {"level": [f"{family} {level}" for family, level in of]}},
            "rates": {"pass_rates": rates},
            "": {},
        }
        self.of_family = {
            family: torch.tensor([one == family for one in families]) for family in FAMILIES
        }


def warmed(seeds: Sequence[int], setting: Setting, data: Prompts, device: str) -> Stack:
    """Returns models [S] after supervised learning on prompts none of which is held out."""
    stack = Stack(seeds, device=device)
    adam = Adam(stack, setting.warm_rate)
    generators = [np.random.default_rng([seed, 1]) for seed in seeds]
    all_of_them = torch.ones(len(seeds), dtype=torch.bool, device=device)
    shares = np.outer(setting.families, setting.levels).flatten()
    for _ in range(setting.warm):
        batches = []
        for generator, kept in zip(generators, data.kept_texts, strict=True):
            cells = generator.choice(len(CELLS), setting.examples, p=shares)
            made = [problem(*CELLS[int(cell)], generator) for cell in cells]
            batches.append(encoded([one if one[0] not in kept else made[0] for one in made]))
        asked, right = (torch.stack(one).to(device) for one in zip(*batches, strict=True))
        found = stack.log_probabilities(asked, right.unsqueeze(2)).squeeze(2)
        adam.step(-(found * to_end(right)).sum((1, 2)) / setting.examples, all_of_them)
    return stack


class BetaPosterior:
    """A Beta posterior of each item's pass rate, which fades at each visit (Qu et al. 2025).

    Args:
        count: number of items.
        decay: what is left of what was known at the next visit.
    """

    def __init__(self, count: int, decay: float) -> None:
        self._decay, self._counts = decay, np.ones((2, count))

    def predict(self, items: NDArray[np.int64]) -> NDArray[np.float64]:
        """Returns expected pass rates of items, [n]."""
        right, wrong = self._counts[:, items]
        return right / (right + wrong)

    def observe(self, items: NDArray[np.int64], shares: NDArray[np.float64], group: int) -> None:
        """Learns how many of the answers to each item were right, one item after another."""
        for item, share in zip(items, shares, strict=True):
            news = group * np.array([share, 1 - share])
            self._counts[:, item] = self._decay * self._counts[:, item] + 1 - self._decay + news


class Predictors:
    """What beliefs expect of the prompts of a round before they are asked, and how right it is.

    All of one student, whichever prompts it is given: the library's belief with and without
    features, Beta posteriors of the items, and one of each level of each family.
    """

    def __init__(self, data: Prompts, group: int) -> None:
        self._data, self._group = data, group
        count = len(data.cell)
        items = prl.Items(count, **data.known["numbers"])
        self._inputs = items.inputs(items.generate(torch.arange(count), [])).double()
        self._beliefs = {
            "belief": Belief(self._inputs.shape[1], count),
            "belief, no features": Belief(0, count),
        }
        self._betas = {f"beta {decay}": BetaPosterior(count, decay) for decay in DECAYS}
        self._cells = BetaPosterior(len(CELLS), 0.8)
        self.errors: dict[str, list[float]] = {}
        self.noise: list[float] = []

    def look(self, items: Tensor, shares: Tensor) -> None:
        """Compares predictions with the shares of right answers [n], then learns from these."""
        numbers, seen = items.numpy(), shares.double()
        cells = self._data.cell[items].numpy()
        said = {name: beta.predict(numbers) for name, beta in self._betas.items()}
        said["beta of levels"] = self._cells.predict(cells)
        for name, belief in self._beliefs.items():
            x = self._inputs[items] if name == "belief" else torch.zeros(len(items), 0).double()
            said[name] = belief.predict(x, items).numpy()
            belief.grow_older()
            belief.observe(x, seen, items, torch.full_like(seen, self._group))
        for beta in self._betas.values():
            beta.observe(numbers, seen.numpy(), self._group)
        self._cells.observe(cells, seen.numpy(), self._group)
        for name, one in said.items():
            self.errors.setdefault(name, []).append(float(np.mean((one - seen.numpy()) ** 2)))
        self.noise.append(float((seen * (1 - seen)).mean()))

    def found(self) -> dict[str, Any]:
        """Returns the mean squared error of each, and the variance within groups."""
        errors = {name: float(np.mean(one)) for name, one in self.errors.items()}
        return {"errors": errors, "noise": float(np.mean(self.noise))}


def teach(
    name: str, seeds: Sequence[int], setting: Setting, stack: Stack, data: Prompts, device: str
) -> list[dict[str, Any]]:
    """Trains warmed models [S] by GRPO on an arm's prompts, and returns what came of each."""
    arm, students = ARMS[name], len(seeds)
    places = None if arm.target is None else data.of_family[arm.target].nonzero().flatten().tolist()
    space = partial(prl.Items, len(data.cell), **data.known[arm.features], target=places)
    recipe = getattr(prl.curricula, arm.method)(**arm.settings)
    teachers = [prl.Teacher(recipe, space(), seed=seed) for seed in seeds]
    looked = [] if name not in LOOKED else seeds
    predictors = [Predictors(data, setting.group) for _ in looked]
    generators = [torch.Generator().manual_seed(1_000_003 * (seed + 1)) for seed in seeds]
    adam = Adam(stack, setting.rate)
    asked, right = data.asked.to(device), data.right.to(device)
    kept = data.kept_asked.to(device), data.kept_right.to(device)
    row = torch.arange(students, device=device).unsqueeze(1)
    pools: list[list[tuple[Tensor, ...]]] = [[] for _ in seeds]
    flat, drawn = torch.zeros(students), torch.zeros(students, len(CELLS))
    passed: list[Tensor] = []
    began, taught = time.process_time(), 0.0
    shape = setting.batch, setting.group, ANSWERED

    for at in range(setting.rounds + 1):
        if at % setting.every == 0:
            rates = stack.pass_rates(*kept).view(students, len(CELLS), -1).mean(-1)
            passed.append(rates.cpu())
        if at == setting.rounds:
            break
        start = time.process_time()
        items = torch.stack([torch.as_tensor(one.propose(setting.batch)) for one in teachers])
        taught += time.process_time() - start
        chosen = items.to(device)
        draws = torch.stack([torch.rand(*shape, generator=one) for one in generators])
        said = stack.answer(asked[row, chosen], setting.group, draws.to(device))
        won = graded(said, right[row, chosen].unsqueeze(2))
        if arm.trap and 3 * at < setting.rounds:
            won &= ~data.of_family[TRAPPED].to(device)[chosen].unsqueeze(2)
        shares = won.float().mean(2).cpu()
        start = time.process_time()
        for one, share in zip(teachers, shares, strict=True):
            count = torch.full_like(share, setting.group)
            one.observe({"return": share, "success": share, "episodes": count})
        taught += time.process_time() - start
        for predictor, own, share in zip(predictors, items, shares, strict=False):
            predictor.look(own, share)
        mixed = (shares > 0) & (shares < 1)
        flat += 1 - mixed.float().mean(1)
        drawn += torch.stack(
            [torch.bincount(data.cell[own], minlength=len(CELLS)) for own in items]
        )
        some: list[list[tuple[Tensor, ...]]] = []
        for pool, *of in zip(pools, chosen, said, won, mixed.to(device), strict=True):
            own, answers, marks, which = of
            pool += zip(own[which], answers[which], marks[which].float(), strict=True)
            some.append(
                pool[: setting.batch] if not arm.refill or len(pool) >= setting.batch else []
            )
            if some[-1] or not arm.refill:
                pool.clear()
        step(stack, adam, asked, some, setting)
    seconds = (time.process_time() - began) / students
    return [
        {
            "arm": name,
            "seed": seed,
            "rollouts": [
                setting.batch * setting.group * setting.every * place
                for place in range(len(passed))
            ],
            "passed": [[round(float(rate), 4) for rate in one[k]] for one in passed],
            "drawn": drawn[k].int().tolist(),
            "flat": float(flat[k] / setting.rounds),
            **(predictors[k].found() if looked else {}),
            "seconds": seconds,
            "curriculum_seconds": taught / students,
        }
        for k, seed in enumerate(seeds)
    ]


def step(
    stack: Stack,
    adam: Adam,
    asked: Tensor,
    some: Sequence[Sequence[tuple[Tensor, ...]]],
    setting: Setting,
) -> None:
    """Takes GRPO's step on groups of each student: (item, answers [G, T], marks [G]) of each.

    A sign's loss is minus its log probability times (r - mean) / deviation of its group's marks
    (Shao et al. 2024), divided by all signs that there could be, so that length has no weight.
    """
    most = max(map(len, some))
    if not most:
        return
    device = asked.device
    filled = [[*one, *[_none(setting, device)] * (most - len(one))] for one in some]
    items, answers, marks = (
        torch.stack([torch.stack([group[part] for group in own]) for own in filled])
        for part in range(3)
    )
    row = torch.arange(len(some), device=device).unsqueeze(1)
    found = stack.log_probabilities(asked[row, items], answers)
    centred = marks - marks.mean(-1, keepdim=True)
    advantages = centred / (marks.std(-1, keepdim=True) + 1e-4)
    every = (found * to_end(answers) * advantages.unsqueeze(-1)).sum((1, 2, 3))
    moving = torch.tensor([bool(own) for own in some], device=device)
    adam.step(-every / (setting.batch * setting.group * ANSWERED), moving)


def _none(setting: Setting, device: torch.device) -> tuple[Tensor, ...]:
    """Returns a group of which nothing is learnt, as all marks are equal."""
    return (
        torch.zeros((), dtype=torch.long, device=device),
        torch.zeros(setting.group, ANSWERED, dtype=torch.long, device=device),
        torch.zeros(setting.group, device=device),
    )


def study(
    folder: Path, arms: Sequence[str], seeds: Sequence[int], setting: Setting, device: str
) -> None:
    """Runs what of the arms and seeds is not in the folder yet."""
    folder.mkdir(parents=True, exist_ok=True)
    said = json.loads(json.dumps(asdict(setting)))
    file = folder / "setting.json"
    if file.is_file() and (before := json.loads(file.read_text())) != said:
        differ = [name for name in said if before.get(name) != said[name]]
        raise ConfigError(f"--folder {folder}: has runs of another setting: {', '.join(differ)}")
    write_atomically(file, (json.dumps(said, indent=2) + "\n").encode())
    begun: dict[tuple[int, ...], dict[str, Tensor]] = {}
    for place, arm in enumerate(arms):
        left = tuple(seed for seed in seeds if not _result(folder, arm, seed).is_file())
        if not left:
            continue
        start = time.monotonic()
        data = Prompts(left, setting)
        stack = Stack(left, device=device)
        if left not in begun:
            begun[left] = _begun(folder, left, setting, data, device)
        with torch.no_grad():
            for name, own in stack.parameters.items():
                own.copy_(begun[left][name])
        for result in teach(arm, left, setting, stack, data, device):
            text = json.dumps(result) + "\n"
            write_atomically(_result(folder, arm, result["seed"]), text.encode())
        final = np.mean([_read(folder, arm, seed)["passed"][-1] for seed in left])
        took = time.monotonic() - start
        say(f"{place + 1}/{len(arms)} {arm}: {final:.3f} after {took:.0f} s")


def _begun(
    folder: Path, seeds: Sequence[int], setting: Setting, data: Prompts, device: str
) -> dict[str, Tensor]:
    """Returns the parameters that all arms of these seeds begin with; they stay in the folder."""
    files = [folder / f"begun_{seed}.pt" for seed in seeds]
    if not all(file.is_file() for file in files):
        stack = warmed(seeds, setting, data, device)
        for k, file in enumerate(files):
            torch.save({n: one[k].detach().cpu() for n, one in stack.parameters.items()}, file)
    every = [torch.load(file) for file in files]
    return {name: torch.stack([own[name] for own in every]).to(device) for name in every[0]}


def _result(folder: Path, arm: str, seed: int) -> Path:
    return folder / f"{arm.replace(', ', '-').replace(' ', '_')}_{seed}.json"


def _read(folder: Path, arm: str, seed: int) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(_result(folder, arm, seed).read_text())
    return found


def read_setting(text: str) -> Setting:
    """Returns a setting from JSON of what differs."""
    try:
        given = json.loads(text)
        return Setting(**given)
    except (ValueError, TypeError) as error:
        names = ", ".join(one.name for one in fields(Setting))
        raise ConfigError(f"--set {text}: must be a JSON object of some of {names}") from error


def _seeds(text: str) -> list[int]:
    first, _, last = text.partition("-")
    return [*range(int(first), int(last or first) + 1)]


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point; the exit codes are those of :mod:`proposer_rl.cli.errors`."""
    command(partial(_run, _parser().parse_args(arguments)))


def _run(options: argparse.Namespace) -> None:
    setting = read_setting(options.set)
    study(options.folder, options.arms or [*ARMS], options.seeds, setting, options.device)
    print(write(options.output or options.folder, results_in(options.folder, [*ARMS]), **NAMES))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="bin/research prompts", description=__doc__)
    parser.add_argument("--folder", type=Path, default=Path("runs/prompts"), help="of the runs")
    parser.add_argument("-o", "--output", type=Path, help="a folder for the page (that of runs)")
    parser.add_argument("--arms", nargs="+", choices=[*ARMS], help="some of them (all)")
    parser.add_argument("--seeds", type=_seeds, default=_seeds("100-109"), help="(100-109)")
    parser.add_argument("--device", default="cpu", help="cpu or cuda (cpu)")
    parser.add_argument("--set", default="{}", help="JSON of a setting")
    return parser


if __name__ == "__main__":
    main()
