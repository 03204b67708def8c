"""From the configuration to where the copies of the Solver are trained."""

from __future__ import annotations

from collections.abc import Callable
from importlib.util import find_spec

import torch

from proposer_rl.cli.config import ConfigError, RunConfig
from proposer_rl.meta.workers import WorkerSettings
from proposer_rl.models.population import available_cores


def workers(
    config: RunConfig, device: torch.device, usable: Callable[[str], torch.device]
) -> WorkerSettings | None:
    """What the settings say of workers; None if everything is to happen in this process.

    Args:
        config: the run's settings.
        device: of the run.
        usable: the device of a name.

    Raises:
        ConfigError: if Ray is missing, or ``usable`` refuses a device.
    """
    if config.collector == "single":
        return None
    if config.collector == "ray" and find_spec("ray") is None:
        raise ConfigError("collector=ray: needs Ray: pip install 'proposer_rl[ray]'")
    on_gpus = device.type == "cuda"
    count = config.workers or min(
        config.proposer.rollouts, torch.cuda.device_count() if on_gpus else available_cores()
    )
    if config.collector == "multiprocess":
        for name in config.worker_devices or []:
            usable(name)
    return WorkerSettings(
        engine=config.collector,
        workers=count,
        devices=config.worker_devices or _devices(config, device),
        cores=config.cores or max(1, available_cores() // count),
        ray_address=config.ray_address,
    )


def _devices(config: RunConfig, device: torch.device) -> list[str]:
    """All GPUs in turn where the run is on one; Ray shows a worker only those that it reserved."""
    if device.type == "cuda" and config.collector == "multiprocess":
        return [f"cuda:{index}" for index in range(torch.cuda.device_count())]
    return [device.type]
