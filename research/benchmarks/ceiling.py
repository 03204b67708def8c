"""The time of an update's convolutions alone: what no update can be faster than, in practice."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product
from statistics import median
from typing import Any

import torch
from torch import nn
from torch.nn import functional as F

from research.benchmarks.plain import PlainUNet
from research.benchmarks.profiling import profile
from research.benchmarks.results import Options, Result, Row, Spread, Table
from research.benchmarks.scales import Solvers, paper, precisions
from research.benchmarks.timing import Timings, interleave

LAYOUTS = {"contiguous": torch.contiguous_format, "channels last": torch.channels_last}
DTYPES = {"fp32": torch.float32, "bf16": torch.bfloat16}


@dataclass(frozen=True)
class Convolution:
    """One convolution of the network; ``first`` needs no gradient of its input."""

    batch: int
    inputs: int
    outputs: int
    kernel: int
    height: int
    width: int
    first: bool

    @property
    def label(self) -> str:
        """For a table."""
        k = self.kernel
        return f"{k}x{k}, {self.inputs}→{self.outputs}, {self.height}x{self.width}"

    @property
    def flops(self) -> int:
        """Multiplications and additions of a forward pass."""
        positions = self.batch * self.height * self.width
        return 2 * positions * self.inputs * self.outputs * self.kernel**2

    @property
    def training_flops(self) -> int:
        """The same of a forward and a backward pass."""
        return self.flops * (2 if self.first else 3)

    def passes(
        self, layout: str, dtype: str, device: str
    ) -> tuple[Callable[[], object], Callable[[], object]]:
        """A forward pass, and a forward and backward pass, on tensors made beforehand."""
        made: dict[str, Any] = {"dtype": DTYPES[dtype], "device": device}
        x = torch.randn(self.batch, self.inputs, self.height, self.width, **made)
        weight = torch.randn(self.outputs, self.inputs, self.kernel, self.kernel, **made)
        x, weight = (tensor.to(memory_format=LAYOUTS[layout]) for tensor in (x, weight))
        bias = torch.zeros(self.outputs, **made)
        slope = torch.randn_like(F.conv2d(x, weight, bias, padding=self.kernel // 2))
        wanted = [weight, bias] if self.first else [x, weight, bias]
        for tensor in wanted:
            tensor.requires_grad_()

        def forward() -> torch.Tensor:
            return F.conv2d(x, weight, bias, padding=self.kernel // 2)

        def evaluate() -> None:
            with torch.no_grad():
                forward()

        def train() -> None:
            torch.autograd.grad(forward(), wanted, slope)

        return evaluate, train


def convolutions(channels: Sequence[int], batch: int, height: int, width: int) -> list[Convolution]:
    """Every convolution of the Solver's network, in the order in which they are applied."""
    found: list[Convolution] = []

    def note(layer: nn.Conv2d, inputs: tuple[torch.Tensor, ...], output: object) -> None:
        (x,) = inputs
        widths = (layer.in_channels, layer.out_channels, layer.kernel_size[0])
        found.append(Convolution(batch, *widths, x.shape[2], x.shape[3], first=not found))

    network = PlainUNet(channels)
    for layer in network.modules():
        if isinstance(layer, nn.Conv2d):
            layer.register_forward_hook(note)
    with torch.no_grad():
        # Two mazes, since GroupNorm refuses a single number per channel.
        network(torch.zeros(2, 3, height, width))
    return found


def against_convolutions(options: Options) -> Result:
    """An update against its convolutions alone, and where the rest of its time goes."""
    scale, dtypes = paper(options), precisions(options)
    tasks = {dtype: scale.task(options, f"precision={dtype}") for dtype in dtypes}
    task = tasks["fp32"]
    layers = convolutions(scale.channels, task.batch_size, task.maze.height, task.maze.width)
    solvers = {dtype: Solvers(task) for dtype, task in tasks.items()}
    candidates: dict[str, Callable[[], object]] = {d: solvers[d].update for d in dtypes}
    for (i, layer), layout, dtype in product(enumerate(layers), LAYOUTS, dtypes):
        forward, both = layer.passes(layout, dtype, options.device)
        candidates[_name(i, "forward", layout, dtype)] = forward
        candidates[_name(i, "training", layout, dtype)] = both
    seconds = interleave(candidates, options.repeats, options.device, warmup=3)
    rows, tables = [], []
    for dtype in dtypes:
        # An update in the faster precision has to stand against the best of both.
        allowed = dtypes if dtype == "bf16" else ["fp32"]
        best = _Best(seconds, len(layers), allowed)
        ceiling = best.ceiling(task.solver.ppo.epochs)
        shares = [c / u for c, u in zip(ceiling, seconds[dtype], strict=True)]
        rows.append(
            Row(
                f"convolutions alone, best of {' and '.join(allowed)}",
                f"a Solver update, {dtype}",
                Spread.of(shares),
                "%",
                target=0.60,
                samples={"update": seconds[dtype], "convolutions": ceiling},
            )
        )
        plain = Solvers(scale.task(options, f"precision={dtype}", "compute.graphs=false"))
        for _ in range(2):
            plain.update()
        title = f"Where a Solver update goes, {dtype}"
        tables.append(profile(plain.update, title, options.device))
    tables.append(_details(layers, _Best(seconds, len(layers), dtypes)))
    return Result(rows, tables)


class _Best:
    """The fastest way of each layer and pass, by the median of its timings."""

    def __init__(self, seconds: Timings, layers: int, dtypes: Sequence[str]) -> None:
        self.seconds = seconds
        self.chosen = {
            kind: [
                min(
                    (_name(i, kind, *way) for way in product(LAYOUTS, dtypes)),
                    key=lambda name: median(seconds[name]),
                )
                for i in range(layers)
            ]
            for kind in ("forward", "training")
        }

    def ceiling(self, epochs: int) -> list[float]:
        """Seconds of a rollout's forward pass and of the epochs, round by round."""
        forward, training = (
            [sum(times) for times in zip(*(self.seconds[name] for name in names), strict=True)]
            for names in self.chosen.values()
        )
        return [f + epochs * t for f, t in zip(forward, training, strict=True)]


def _details(layers: list[Convolution], best: _Best) -> Table:
    lines = []
    for i, layer in enumerate(layers):
        cells = [layer.label]
        for kind, flops in (("forward", layer.flops), ("training", layer.training_flops)):
            name = best.chosen[kind][i]
            took = median(best.seconds[name])
            cells += [f"{1e3 * took:.3g}", f"{flops / took / 1e12:.2f}", name.split(", ", 2)[2]]
        lines.append(cells)
    header = ["convolution", "forward ms", "TFLOP/s", "best in"]
    header += ["forward + backward ms", "TFLOP/s", "best in"]
    return Table("Every convolution in its best layout and dtype", header, lines)


def _name(layer: int, kind: str, layout: str, dtype: str) -> str:
    return f"convolution {layer}, {kind}, {layout}, {dtype}"
