"""A task on a GPU: rollouts, training and measurements are recorded as CUDA graphs, and replayed.

Thousands of small kernels cost a GPU less time than it takes Python to ask for them one by one. A
graph asks for all of them at once. It repeats kernels on the memory that they were recorded with
and runs no Python, so a function that is to be recorded reads nothing back from the device, and
what it reads and changes besides its inputs (weights, an optimiser's state, the levels that an
environment plays) stays where it is.

Nothing of this has run on a GPU yet: it is tested with a recorder for the CPU alone.

``tensordict.nn.CudaGraphModule`` does the same, but waits for the device before every replay.
"""

from __future__ import annotations

import copy
import warnings
from collections.abc import Callable
from typing import Any, Protocol, TypeVar
from weakref import WeakKeyDictionary

import torch
from tensordict import TensorDict, TensorDictBase

T = TypeVar("T")

WARM_UPS = 2
"""Calls before the recording, in which libraries choose kernels and constants are made."""


class Recorder(Protocol):
    """What :class:`Captured` needs of a device; the tests have one for the CPU."""

    def warm_up(self, function: Callable[[], T]) -> T:
        """Call a function as it is, in preparation for its recording."""

    def record(self, function: Callable[[], T]) -> tuple[T, Callable[[], object]]:
        """Record what a function asks of the device, without doing any of it.

        Returns:
            The function's result, whose memory is filled by every call of what comes with it.
        """


class CudaGraphs:
    """Records CUDA graphs.

    Args:
        device: the GPU.
    """

    def __init__(self, device: torch.device) -> None:
        self._device = device

    def warm_up(self, function: Callable[[], T]) -> T:
        """Call the function on a stream of its own, as CUDA asks of what is recorded later."""
        with torch.cuda.device(self._device):
            stream, current = torch.cuda.Stream(), torch.cuda.current_stream()
            stream.wait_stream(current)
            with torch.cuda.stream(stream), warnings.catch_warnings():
                # Adam's, of steps that are not recorded: these two are for the sake of the others.
                warnings.filterwarnings("ignore", "This instance was constructed with capturable")
                result = function()
            current.wait_stream(stream)
        return result

    def record(self, function: Callable[[], T]) -> tuple[T, Callable[[], object]]:
        """Record the function as a graph with memory of its own."""
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.device(self._device), torch.cuda.graph(graph):
            result = function()
        return result, graph.replay


def use(device: torch.device) -> None:
    """Make a GPU the current one, and let its fp32 products round their factors to TF32.

    Without a GPU it does nothing.
    """
    if device.type == "cuda":
        if device.index is not None:  # Ray's workers see none but their own
            torch.cuda.set_device(device)
        torch.set_float32_matmul_precision("high")


def recorded(task: T, recorder: Recorder | None = None) -> T:
    """A copy of a task whose learners and measurements are replayed.

    Of the learners that it makes, acting and training are recorded; of the task, ``probe`` and
    ``measure`` for every agent where measurements are exact, and ``performance`` where it is.
    Otherwise they may draw random numbers, which a graph would repeat, or look whether all episodes
    have ended, and are called as they are. All the rest is the task's own.

    Args:
        task: as :mod:`proposer_rl.task` describes it. It stays as it is.
        recorder: of the task's device; None for CUDA graphs on a GPU, and for the task itself
            elsewhere.
    """
    original: Any = task
    if recorder is None:
        if original.device.type != "cuda":
            return task
        recorder = CudaGraphs(original.device)

    def performance(inputs: TensorDictBase, agent: object) -> TensorDictBase:
        return original.performance(agent, inputs["levels"], None)

    def probe(inputs: TensorDictBase, agent: object) -> TensorDictBase:
        return TensorDict({"probes": original.probe(agent, inputs["levels"])})

    def measure(_: TensorDictBase, agent: object) -> TensorDictBase:
        return original.measure(agent)

    def learner(streams: object) -> Any:
        ppo = original.learner(streams)
        ppo.prepare_for_graphs()
        ppo.collector.act = Captured(ppo.collector.act, recorder)
        ppo.train = Captured(ppo.train, recorder)
        return ppo

    rate, see, sum_up = (Captured(f, recorder) for f in (performance, probe, measure))
    # A copy, and no wrapper, so that it is of the task's class and of all its protocols.
    twin = copy.copy(original)
    twin.learner = learner
    if original.facts["exact"]:
        twin.probe = lambda agent, levels: see(TensorDict({"levels": levels}), agent)["probes"]
        twin.measure = lambda agent: sum_up(TensorDict({}), agent)
    if original.exact_performance:
        twin.performance = lambda agent, levels, _: rate(TensorDict({"levels": levels}), agent)
    return twin


class Captured:
    """A function whose work is recorded, once for each shape of its inputs.

    The first calls run the function as it is. Then it is recorded, on inputs of its own; from there
    on a call copies its inputs there, replays, and returns a copy of the outputs.

    Args:
        function: from a tensordict, and any further objects, to a tensordict. It keeps to what the
            module says of recorded functions.
        recorder: of the device that the tensors are on.
    """

    def __init__(self, function: Callable[..., TensorDictBase], recorder: Recorder) -> None:
        self._function = function
        self._recorder = recorder
        self._recordings: WeakKeyDictionary[object, dict[Any, _Recording]] = WeakKeyDictionary()

    def __call__(self, inputs: TensorDictBase, *agent: object) -> TensorDictBase:
        """Apply the function.

        Args:
            inputs: tensors, other ones at every call.
            agent: at most one further argument; each has recordings of its own, which end with it.

        Returns:
            The function's outputs, which later calls leave alone.

        Raises:
            RuntimeError: if the function cannot be recorded.
        """
        recordings = self._recordings.setdefault(agent[0] if agent else self, {})
        shapes = _shapes(inputs)
        if shapes not in recordings:
            recordings[shapes] = _Recording(self._function, self._recorder)
        return recordings[shapes](inputs, *agent)


class _Recording:
    """The function on inputs of one shape."""

    _inputs: TensorDictBase
    _outputs: TensorDictBase

    def __init__(self, function: Callable[..., TensorDictBase], recorder: Recorder) -> None:
        self._function = function
        self._recorder = recorder
        self._calls = 0
        self._replay: Callable[[], object] | None = None

    def __call__(self, inputs: TensorDictBase, *agent: object) -> TensorDictBase:
        self._calls += 1
        if self._calls <= WARM_UPS:
            return self._recorder.warm_up(lambda: self._function(inputs, *agent))
        if self._replay is None:
            self._inputs = inputs.clone()
            self._outputs, self._replay = self._record(*agent)
        else:
            self._inputs.update_(inputs)
        self._replay()
        return self._outputs.clone()

    def _record(self, *agent: object) -> tuple[TensorDictBase, Callable[[], object]]:
        try:
            return self._recorder.record(lambda: self._function(self._inputs, *agent))
        except RuntimeError as error:
            name = getattr(self._function, "__qualname__", self._function)
            raise RuntimeError(
                f"{name} cannot be recorded as a CUDA graph; compute.graphs=false does without: "
                f"{error}"
            ) from error


def _shapes(inputs: TensorDictBase) -> tuple[Any, ...]:
    leaves = sorted(
        (str(key), tuple(entry.shape), str(entry.dtype))
        for key, entry in inputs.items(include_nested=True, leaves_only=True)
    )
    return (tuple(inputs.batch_size), *leaves)
