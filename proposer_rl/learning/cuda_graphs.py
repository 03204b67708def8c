"""A task on a GPU: rollouts, training and measurements as CUDA graphs, by tensordict.

Thousands of small kernels cost a GPU less time than it takes Python to ask for them one by one. A
graph asks for all of them at once. It repeats kernels on the memory that they were recorded with
and runs no Python, so a function that is recorded reads nothing back from the device, and what it
reads and changes besides its inputs (weights, an optimiser's state, the levels that an environment
plays) stays where it is.

Nothing of this has run on a GPU yet, so it is off unless ``compute.graphs=true`` asks for it.
"""

from __future__ import annotations

import copy
import warnings
from collections.abc import Callable
from typing import Any, TypeVar
from weakref import WeakKeyDictionary

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import CudaGraphModule

T = TypeVar("T")

WARM_UPS = 2
"""Calls that run the function itself; it is recorded in the last of them, and replayed later."""


def use(device: torch.device) -> None:
    """Make a GPU the current one, and let its fp32 products round their factors to TF32.

    Without a GPU it does nothing.
    """
    if device.type == "cuda":
        if device.index is not None:  # Ray's workers see none but their own
            torch.cuda.set_device(device)
        torch.set_float32_matmul_precision("high")


def recorded(task: T) -> T:
    """A copy of a task on a GPU whose learners and measurements are replayed as CUDA graphs.

    Of the learners that it makes, acting and training are recorded; of the task, ``probe`` and
    ``measure`` for every agent where measurements are exact, and ``performance`` where it is.
    Otherwise they may draw random numbers, which a graph would repeat, or look whether all episodes
    have ended, and are called as they are. All the rest is the task's own.

    Args:
        task: as :mod:`proposer_rl.task` describes it. It stays as it is, and is returned where its
            device is no GPU.
    """
    original: Any = task
    if original.device.type != "cuda":
        return task

    def learner(streams: object) -> Any:
        ppo = original.learner(streams)
        ppo.prepare_for_graphs()
        ppo.collector.act = _graph(ppo.collector.act)
        ppo.train = _graph(ppo.train)
        return ppo

    def probe(inputs: TensorDictBase, agent: object) -> TensorDictBase:
        return TensorDict({"probes": original.probe(agent, inputs["levels"])})

    def performance(inputs: TensorDictBase, agent: object) -> TensorDictBase:
        return original.performance(agent, inputs["levels"], None)

    see, rate = _OfAgents(probe), _OfAgents(performance)
    sum_up = _OfAgents(lambda _, agent: original.measure(agent))
    # A copy, and no wrapper, so that it is of the task's class and of all its protocols.
    twin = copy.copy(original)
    twin.learner = learner
    if original.facts["exact"]:
        twin.probe = lambda agent, levels: see(agent, levels=levels)["probes"]
        twin.measure = sum_up
    if original.exact_performance:
        twin.performance = lambda agent, levels, _: rate(agent, levels=levels)
    return twin


class _OfAgents:
    """A measurement of agents: a graph for each and for each number of levels, which ends with it.

    Args:
        function: from a tensordict with what is given by name, and an agent, to a tensordict.
    """

    def __init__(self, function: Callable[[TensorDictBase, object], TensorDictBase]) -> None:
        self._function = function
        self._graphs: WeakKeyDictionary[object, dict[Any, Callable[..., TensorDictBase]]]
        self._graphs = WeakKeyDictionary()

    def __call__(self, agent: object, **given: Any) -> TensorDictBase:
        graphs = self._graphs.setdefault(agent, {})
        size = tuple(entry.batch_size for entry in given.values())
        if size not in graphs:
            graphs[size] = _graph(self._function)
        # The agent is no part of what is recorded, and so is not kept alive by it.
        return graphs[size](TensorDict(given), agent)


def _graph(function: Callable[..., TensorDictBase]) -> Callable[..., TensorDictBase]:
    """The function from a tensordict to another, replayed from its third call on."""
    with warnings.catch_warnings():
        # Tensordicts are no pytrees from here on, which nothing here takes them for.
        warnings.filterwarnings("ignore", message="Tensordict is registered in PyTree")
        module = CudaGraphModule(function, warmup=WARM_UPS, in_keys=[])

    def call(inputs: TensorDictBase, *agent: object) -> TensorDictBase:
        if module.counter < WARM_UPS:
            # It keeps the inputs that it records, which later replays write over, and so would what
            # came of them.
            return module(inputs.clone(), *agent).clone()
        return module(inputs, *agent)

    return call
