"""The settings that a run has only on the command line: named parts, loggers, where it computes."""

from __future__ import annotations

from typing import Annotated, Literal

from annotated_types import Ge, Le, Len

from proposer_rl.settings import settings


@settings
class HandDesignedSettings:
    """A hand-designed curriculum.

    Attributes:
        distributions: of the task, in order.
        until: updates after which each but the last ends.
    """

    distributions: list[str]
    until: list[Annotated[int, Ge(1)]]


@settings
class PoolSettings:
    """How many levels curricula keep, and choose among.

    Attributes:
        capacity: levels of a buffer.
        candidates: levels that are scored to keep some of them.
        keep: of the candidates.
        simplest: values of the space's axes with the easiest bins; None for all bins.
    """

    capacity: Annotated[int, Ge(1)]
    candidates: Annotated[int, Ge(1)]
    keep: Annotated[int, Ge(1)]
    simplest: dict[str, list[float]] | None = None


@settings
class LoggerSettings:
    """Where rows of metrics go besides the run's folder.

    Attributes:
        type: ``csv`` for nowhere.
        project, mode: of Weights & Biases; None for what its own variables say, WANDB_PROJECT and
            WANDB_MODE, or else ``proposer_rl`` and ``online``.
    """

    type: Literal["csv", "tensorboard", "wandb"]
    project: str | None = None
    mode: Literal["online", "offline", "disabled"] | None = None


@settings
class ComputeSettings:
    """Where and how a run is computed, which changes no numbers beyond rounding.

    Attributes:
        device: ``auto``: cuda where there is one, else cpu.
        graphs: replay on a GPU what can be recorded as CUDA graphs.
        threads: CPU threads of one operation; None leaves torch's choice.
        cores: replicas of the Solver computed at once on a CPU; None for all cores.
        collector: where a Proposer's copies are trained: in this process, in several, or by Ray.
        workers: processes for them; None for one for each GPU, or core, at most one for each copy.
        worker_devices: of the workers, in turn; None for all GPUs, or the CPU.
        ray_address: of a Ray cluster, such as auto or 10.0.0.1:6379; None for one on this machine.
        progress: draw progress bars.
    """

    device: str = "auto"
    graphs: bool = True
    threads: Annotated[int, Ge(1), Le(1024)] | None = None
    cores: Annotated[int, Ge(1), Le(1024)] | None = None
    collector: Literal["single", "multiprocess", "ray"] = "single"
    workers: Annotated[int, Ge(1)] | None = None
    worker_devices: Annotated[list[str], Len(1)] | None = None
    ray_address: str | None = None
    progress: bool = True
