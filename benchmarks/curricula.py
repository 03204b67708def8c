"""What a curriculum costs: seconds of a Solver update against those of domain randomization."""

from __future__ import annotations

from benchmarks.results import Options, Result, Row, Spread, Table
from benchmarks.scales import PAPER, QUICK, TINY, Scale
from benchmarks.timing import Timings, interleave, ratio, threads, total
from proposer_rl.streams import Streams

REFERENCE = "domain_randomization"
# Those that train no copies of the Solver.
COMPARED = ("hand_made", "first_order_gain", "first_order_sampled", "first_order_proposer")
STRETCH = 2  # updates timed together: a curriculum may look at the Solver only now and then


def update_seconds(options: Options) -> Result:
    """Updates with all that a curriculum does for them, its share of improvements included."""
    rows, lines = [], []
    for scale in [TINY] if options.tiny else [QUICK, PAPER]:
        with threads(scale.threads):
            seconds = _seconds(scale, [REFERENCE, *COMPARED], options)
        for name in COMPARED:
            rows.append(
                Row(
                    f"a Solver update of {name}, {scale.name} values",
                    f"of {REFERENCE}",
                    ratio(seconds[name], seconds[REFERENCE]),
                    "x",
                    target=1.35 if scale == PAPER else None,
                    at_most=True,
                    samples=seconds,
                )
            )
        lines += [
            [scale.name, name, f"{1e3 * Spread.of(times).median:.1f}"]
            for name, times in seconds.items()
        ]
    return Result(rows, [Table("Seconds of an update", ["values", "method", "ms"], lines)])


def _seconds(scale: Scale, names: list[str], options: Options) -> Timings:
    """Of an update of each method, by its name."""
    repeats = options.few if scale == PAPER else options.repeats
    trained = {name: Training(Scale(scale.name, name), options) for name in names}
    candidates = {f"{name}: updates": t.updates for name, t in trained.items()}
    candidates |= {f"{name}: improvement": t.improve for name, t in trained.items()}
    cycle = scale.config.schedule.cycle_length
    seconds = interleave(candidates, repeats, options.device)
    return {
        name: total(seconds, {f"{name}: updates": 1 / STRETCH, f"{name}: improvement": 1 / cycle})
        for name in names
    }


class Training:
    """A Solver on a curriculum, as in a run but for measurements and checkpoints."""

    def __init__(self, scale: Scale, options: Options) -> None:
        self.task, self.learner, self.curriculum = scale.made(options)
        self.count = 0

    def improve(self) -> None:
        """What comes before a cycle."""
        self.curriculum.improve(self.learner, self.count, [Streams(0, "cycle", self.count)])

    def updates(self) -> None:
        """The next updates."""
        for _ in range(STRETCH):
            stream = Streams(0, "update", self.count)
            levels = self.curriculum.propose(self.learner, self.count, [stream]).levels
            self.learner.env.set_levels(levels)
            update = self.learner.update([stream.generator("actions")])
            self.learner.check()
            self.curriculum.observe(self.learner, levels, update)
            self.count += 1
