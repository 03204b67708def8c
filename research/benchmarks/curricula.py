"""What a curriculum costs: seconds of a Solver update against those of domain randomization."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from proposer_rl.cli.build import Made, parts
from proposer_rl.cli.config import RunConfig, checked_config
from proposer_rl.curricula import LearnedCurriculum, TaskStudent, outcome_of
from proposer_rl.curricula.contract import proposed
from proposer_rl.report.reading import UnreadableRun, find_runs
from proposer_rl.report.studies import Group, Study, read_studies
from proposer_rl.runs.process import StopSignals
from proposer_rl.streams import Streams
from research.benchmarks.results import Options, Result, Row, Spread, Table
from research.benchmarks.scales import PAPER, QUICK, TINY, Scale
from research.benchmarks.timing import Timings, interleave, ratio, threads, total

REFERENCE = "domain_randomization"
# Those that train no copies of the Solver.
COMPARED = ("hand_designed", "first_order_gain", "first_order_proposer")
STRETCH = 2  # updates timed together: a curriculum may look at the Solver only now and then


def update_seconds(options: Options) -> Result:
    """Updates with all that a curriculum does for them, its share of improvements included."""
    if options.runs:
        return _of_runs(options)
    results = []
    for scale in [TINY] if options.tiny else [QUICK, PAPER]:
        with threads(scale.threads):
            seconds = _seconds(scale, [REFERENCE, *COMPARED], options)
        target = 1.35 if scale == PAPER else None
        results.append(_told(seconds, REFERENCE, f"{scale.name} values", target))
    return Result(
        [row for result in results for row in result.rows],
        [table for result in results for table in result.tables],
    )


def read_methods(folders: Sequence[str]) -> Study:
    """The runs whose methods are timed.

    Raises:
        UnreadableRun, ConfigError: unless they are of several methods, all measured alike, with
            settings that can be read.
    """
    studies, _ = read_studies(find_runs([Path(folder) for folder in folders]), None)
    if len(studies) > 1:
        titles = "; ".join(study.title for study in studies)
        raise UnreadableRun(f"the runs were not measured alike ({titles})")
    (study,) = studies
    if len(study.compared) < 2:
        raise UnreadableRun("the runs are of one method, with which nothing can be compared")
    for group in study.compared:
        _config(group)
    return study


def _of_runs(options: Options) -> Result:
    """Whole cycles: what a curriculum does only now and then has its share.

    They take minutes where copies are trained, so that the first of them counts, too; it is the
    longest where something is recorded or filled, which a median leaves out.
    """
    study = read_methods(options.runs)
    lengths = {g.label: g.runs[0].config["schedule"]["cycle_length"] for g in study.compared}
    cycles = {
        group.label: partial(Training(_made(group, options)).cycle, lengths[group.label])
        for group in study.compared
    }
    timings = interleave(cycles, options.few, options.device, warmup=0)
    seconds = {name: [each / lengths[name] for each in times] for name, times in timings.items()}
    return _told(seconds, study.baseline.label, study.title)


def _config(group: Group) -> RunConfig:
    """The settings of a group's first run, in a folder or in a study."""
    run = group.runs[0]
    return checked_config(run.config, run.folder)


def _made(group: Group, options: Options) -> Made:
    """Task, Solver and curriculum as in a group's first run."""
    config = _config(group)
    schedule = replace(config.schedule, updates=group.runs[0].updates)
    compute = replace(config.compute, threads=None, device=options.device)  # as this process has
    whole = replace(config, schedule=schedule, compute=compute)
    return parts(whole, StopSignals())


def _told(seconds: Timings, reference: str, where: str, target: float | None = None) -> Result:
    rows = [
        Row(
            f"a Solver update of {name}, {where}",
            f"of {reference}",
            ratio(times, seconds[reference]),
            "x",
            target=target,
            at_most=True,
            samples=seconds,
        )
        for name, times in seconds.items()
        if name != reference
    ]
    lines = [[name, f"{1e3 * Spread.of(times).median:.1f}"] for name, times in seconds.items()]
    return Result(rows, [Table(f"Seconds of an update, {where}", ["method", "ms"], lines)])


def _seconds(scale: Scale, names: list[str], options: Options) -> Timings:
    """Of an update of each method, by its name."""
    repeats = options.few if scale == PAPER else options.repeats
    trained = {name: Training(Scale(scale.name, name).made(options)) for name in names}
    candidates: dict[str, Callable[[], None]]
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

    def __init__(self, made: Made) -> None:
        task, self.learner, (self.curriculum,) = made
        self.student = TaskStudent(task, self.learner)
        self.count = 0

    def cycle(self, length: int) -> None:
        """An improvement, and the updates that the Solver has to the next."""
        self.improve()
        self.updates(length)

    def improve(self) -> None:
        """What comes before a cycle."""
        if isinstance(self.curriculum, LearnedCurriculum):
            self.curriculum.improve(self.student, Streams(0, "cycle", self.count))
        self.curriculum.log()

    def updates(self, count: int = STRETCH) -> None:
        """The next updates."""
        for _ in range(count):
            stream = Streams(0, "update", self.count)
            size = self.learner.env.batch_size[1:].numel()
            batch = proposed(self.curriculum, self.student, size, stream)
            self.learner.env.set_levels(batch.levels.unsqueeze(0))
            update = self.learner.update([stream.generator("actions")])
            self.learner.check()
            self.curriculum.observe(self.student, batch, outcome_of(update.rollout[0]))
            self.count += 1
