"""Replays functions of tensordicts as CUDA graphs, with tensordict's ``CudaGraphModule``.

Launching thousands of small kernels one by one from Python takes longer than running them; a graph
launches all of them at once. It repeats the recorded kernels on the recorded memory and runs no
Python. So a recorded function must read nothing back from the device, and everything it reads and
changes besides its inputs (weights, the state of an optimiser, the levels of an environment) must
stay in the same memory.
"""

from __future__ import annotations

import gc
import logging
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any
from weakref import WeakKeyDictionary

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import CudaGraphModule
from torch.utils._pytree import tree_leaves

from proposer_rl.settings import ArgumentError

WARM_UPS = 2  # calls before replaying; the last of them is recorded


class GraphError(ArgumentError):
    """A function cannot be recorded as a CUDA graph; the message is one line."""

    exit_code = 2


def has_graphs(device: torch.device) -> bool:
    """Returns whether a device can replay functions."""
    return device.type == "cuda"


def replayed(function: Callable[..., TensorDictBase]) -> Callable[..., TensorDictBase]:
    """Wraps a function so that a GPU replays it from the third call on, with the same results.

    Args:
        function: from a tensordict, and further objects that are the same in every call, to a
            tensordict. Inputs must keep their shapes.

    Returns:
        A function that returns new tensors each time. It raises a GraphError if the function cannot
        be recorded.
    """
    with warnings.catch_warnings():
        # CudaGraphModule changes how pytrees treat tensordicts, which nothing here relies on.
        warnings.filterwarnings("ignore", message="Tensordict is registered in PyTree")
        logging.getLogger("tensordict").setLevel(logging.WARNING)  # a line for each graph
        module = CudaGraphModule(function, warmup=WARM_UPS, in_keys=[])

    def call(inputs: TensorDictBase, *others: object) -> TensorDictBase:
        if module.counter < WARM_UPS:
            # Replays overwrite the recorded inputs and outputs, so both are copied here.
            try:
                with _no_garbage():
                    return module(inputs.clone(), *others).clone()
            except RuntimeError as error:
                name, why = getattr(function, "__qualname__", function), str(error).split("\n")[0]
                raise GraphError(
                    f"graphs=True: {name} cannot be recorded as a CUDA graph; set graphs=False "
                    f"({why})"
                ) from error
        return module(inputs, *others)

    return call


@contextmanager
def _no_garbage() -> Iterator[None]:
    """Pauses garbage collection: collecting another graph would spoil a recording."""
    gc.collect()
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


class ReplayedOfAgents:
    """Records a function of an agent and levels once for each agent and each size.

    Args:
        function: of an agent, of levels if there are any, and of arguments that do not affect the
            result, such as a generator that is not used.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function = function
        self._graphs: WeakKeyDictionary[Any, dict[Any, Any]] = WeakKeyDictionary()

    def __call__(self, agent: Any, *given: Any) -> Any:
        """Calls the function, or replays the recording for this agent and these sizes."""
        inputs = TensorDict({"levels": given[0]} if given else {})
        size = tuple(entry.shape for entry in tree_leaves(inputs.to_dict()))
        graphs = self._graphs.setdefault(agent, {})
        if size not in graphs:
            graphs[size] = replayed(self._apply)
        # The agent is not part of the recording, which therefore does not keep it alive.
        return graphs[size](inputs, agent, *given[1:])["result"]

    def _apply(self, inputs: TensorDictBase, agent: Any, *others: Any) -> TensorDictBase:
        levels = [inputs["levels"]] if "levels" in inputs.keys() else []
        return TensorDict({"result": self._function(agent, *levels, *others)})
