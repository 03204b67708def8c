"""A device in Python that refuses what CUDA refuses: to mix its tensors with those of the CPU.

Its numbers are the CPU's. Where another device is registered, torch behaves differently all over
the process, so what is to run on it has a process of its own: see tests/processes.py.
It knows no autocast, pinned memory or streams, and of graphs what may not be in them: numbers that
go from a device to the other.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode, return_and_correct_aliasing
from torch.utils._pytree import tree_leaves, tree_map
from torch.utils.backend_registration import _setup_privateuseone_for_python_backend

from tests.host_reads import refuse_host_reads

NAME = "pretended"
CPU = torch.device("cpu")
INDEXING = {"index", "index_put", "index_put_", "_index_put_impl_", "_unsafe_index"}


class There(Tensor):
    """A tensor that says that it is on the device.

    Attributes:
        here: its numbers.
    """

    here: Tensor
    __torch_function__ = torch._C._disabled_torch_function_impl

    @staticmethod
    def __new__(cls, here: Tensor) -> There:
        made = torch.Tensor._make_wrapper_subclass(
            cls,
            here.size(),
            strides=here.stride(),
            storage_offset=here.storage_offset(),
            dtype=here.dtype,
            device=torch.device(NAME, 0),
        )
        made.here = here
        return made

    def __tensor_flatten__(self) -> tuple[list[str], None]:
        """What counts bytes asks where they are."""
        return ["here"], None

    def tolist(self) -> Any:
        return self.here.tolist()

    def numpy(self, *_: Any, **__: Any) -> Any:
        raise TypeError("numpy() of a tensor that is not on the CPU")

    __array__ = numpy

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return dispatch(func, args, kwargs or {})


class Device(TorchDispatchMode):
    """Within it tensors can be made there."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return dispatch(func, args, kwargs or {})


def dispatch(func: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
    """An operation as the device would do it.

    Raises:
        RuntimeError: where it would mix devices.
    """
    name = func.overloadpacket.__name__
    if Recorded.now:
        _refuse_to_record(func, name, args, kwargs)
    tensors = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, Tensor)]
    there = [tensor for tensor in tensors if isinstance(tensor, There)]
    asked = kwargs.get("device")
    to = any(isinstance(t, There) for t in tensors) if asked is None else _is_there(asked)
    if asked is not None:
        kwargs = {**kwargs, "device": CPU}
    if name == "_to_copy":
        result = func(_here(args[0]), **kwargs)
        return There(result) if to else result
    if not there:
        result = func(*args, **kwargs)
        return There(result) if to else result
    if name == "copy_":
        _here(args[0]).copy_(_here(args[1]))
        return args[0]
    _refuse_to_mix(func, name, args, kwargs, tensors)
    result = func(*tree_map(_here, args), **tree_map(_here, kwargs))
    if name == "_local_scalar_dense" or not to:
        return result
    own = {id(tensor.here): tensor for tensor in there}  # what was changed in place

    def back(value: Any) -> Any:
        return own.get(id(value)) or There(value) if isinstance(value, Tensor) else value

    if func._schema.is_mutable:
        return tree_map(lambda v: own[id(v)] if id(v) in own else back(v), result)
    wrapped = tree_map(lambda v: There(v) if isinstance(v, Tensor) else v, result)
    return return_and_correct_aliasing(func, args, kwargs, wrapped)


def _refuse_to_mix(
    func: Any, name: str, args: tuple[Any, ...], kwargs: dict[str, Any], tensors: list[Tensor]
) -> None:
    """CUDA takes scalars, and indices of its tensors, from the CPU, and nothing else."""
    strangers = [t for t in tensors if not isinstance(t, There) and t.ndim]
    if name in INDEXING:
        if not isinstance(args[0], There):
            raise RuntimeError(f"{func}: indices on the device, of a tensor on the CPU")
        strangers = [t for t in strangers if not any(t is index for index in args[1])]
    if strangers:
        shapes = [tuple(t.shape) for t in strangers]
        raise RuntimeError(f"{func}: {shapes} on the CPU, others on the device")
    if kwargs.get("generator") is not None:
        raise RuntimeError(f"{func}: a generator of the CPU for a tensor on the device")


class Recorded:
    """A function that a GPU would replay as a graph from its third call on.

    Attributes:
        now: whether one is being called that would have been recorded.
    """

    now = False

    def __init__(self, function: Any) -> None:
        self._function, self._calls = function, 0

    def __call__(self, *given: Any) -> Any:
        self._calls += 1
        Recorded.now = self._calls > 1  # the first call makes constants
        try:
            return self._function(*given)
        finally:
            Recorded.now = False


def _refuse_to_record(func: Any, name: str, args: tuple[Any, ...], kwargs: dict[str, Any]) -> None:
    there = isinstance(args[0], There) if args else False
    asked = kwargs.get("device")
    if name == "_to_copy" and asked is not None and _is_there(asked) != there:
        raise RuntimeError(f"{func}: recorded, and goes from one device to the other")
    if there and (name == "_local_scalar_dense" or name in INDEXING):
        refuse_host_reads(func, args)
        indices = args[1] if name in INDEXING else []
        if any(isinstance(i, Tensor) and not isinstance(i, There) for i in indices):
            raise RuntimeError(f"{func}: recorded, with indices on the CPU")


def _here(value: Any) -> Any:
    return value.here if isinstance(value, There) else value


def _is_there(device: Any) -> bool:
    return torch.device(device).type == NAME


def register() -> None:
    """Make torch know the device, and do for it what it does for those that it has."""
    _setup_privateuseone_for_python_backend(NAME)
    module = getattr(torch, NAME)
    module.synchronize = lambda *_: None
    module.current_device = lambda: 0
    module.is_available = lambda: True
    module.get_amp_supported_dtype = lambda: [torch.bfloat16]  # also asked to leave autocast out
    make = torch.tensor

    def tensor(data: Any, *given: Any, device: Any = None, **named: Any) -> Tensor:
        return make(data, *given, **named).to(device or CPU)

    torch.tensor = tensor  # the one that is made without being dispatched


def train(folder: Path, overrides: list[str]) -> None:
    """As the command does, on the device; the folder is that of the run."""
    from proposer_rl.cli.build import build, parts
    from proposer_rl.learning import graphs
    from proposer_rl.runs.folder import RunFolder
    from proposer_rl.runs.process import StopSignals
    from tests.tiny import composed

    graphs.has_graphs = lambda device: device.type == NAME
    graphs.replayed = Recorded
    config, signals = composed(*overrides, f"compute.device={NAME}"), StopSignals()
    build(config, parts(config, signals), RunFolder(folder), signals).run()


def main() -> None:
    """Make the run whose folder and settings are the arguments."""
    register()
    torch.set_num_threads(1)
    folder, *overrides = sys.argv[1:]
    with Device():
        train(Path(folder), overrides)
