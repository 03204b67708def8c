"""Checkpoints that survive a crash at any moment, and that cannot run code when they are read.

A checkpoint is one file, ``step_000000123.pt``: a line with the SHA-256 of all that follows, a line
of JSON with the format's number and the step, and the output of ``torch.save``. It appears under
its name only when it is complete and on the disk.

``torchrl.checkpoint`` (0.14) writes atomically and rotates, too, but it neither waits for the disk
nor keeps a checksum, and does not fall back to an older checkpoint if the newest is damaged.
"""

from __future__ import annotations

import hashlib
import io
import json
import logging
import os
import re
from pathlib import Path
from typing import Any

import torch

from proposer_rl.runs.folder import PROPOSER, storage, write_atomically

FORMAT = 2

_LOG = logging.getLogger(__name__)
_FILE_NAME = re.compile(r"step_(\d+)\.pt")
_PLAIN = (bool, int, float, str, type(None))

State = dict[str, Any]


class CheckpointError(ValueError):
    """A checkpoint cannot be used; the message is one line that names the file."""

    exit_code = 2


class _DamagedError(CheckpointError):
    """The file is damaged; an older one may be intact."""


def save_checkpoint(folder: str | os.PathLike[str], step: int, state: State, keep: int = 2) -> Path:
    """Writes a checkpoint and removes older ones.

    Args:
        folder: for checkpoints; created if it does not exist.
        step: the run's step. A checkpoint of the same step is replaced. Later ones are removed:
            they are damaged, since the run did not resume from them.
        state: nested dicts, lists and tuples of tensors, numbers, texts and None. Tensors are
            detached and moved to the CPU, so that a run can be resumed on another device.
        keep: how many of the newest checkpoints to keep.

    Returns:
        The checkpoint's file.

    Raises:
        CheckpointError: if the state holds values of other types.
        StorageError: if the file cannot be written. In either case existing checkpoints remain.
    """
    folder = Path(folder)
    path = folder / f"step_{step:09d}.pt"
    content = checkpoint_bytes(step, state)
    with storage(folder):
        folder.mkdir(parents=True, exist_ok=True)
        for leftover in folder.glob(".step_*.pt.tmp"):
            leftover.unlink()
    write_atomically(path, content)
    with storage(folder):
        files = checkpoint_files(folder)
        kept = [old for number, old in files if number <= step][-keep:]
        for _, old in files:
            if old not in kept:
                old.unlink()
    return path


def checkpoint_bytes(step: int, state: State) -> bytes:
    """Returns the content of a checkpoint's file; see :func:`save_checkpoint`."""
    payload = io.BytesIO()
    torch.save(_plain(state, "state"), payload)
    body = json.dumps({"format": FORMAT, "step": step}).encode() + b"\n" + payload.getvalue()
    return hashlib.sha256(body).hexdigest().encode() + b"\n" + body


def checkpoint_files(folder: Path) -> list[tuple[int, Path]]:
    """Returns the steps and files of the checkpoints in a folder, oldest step first."""
    matches = [(_FILE_NAME.fullmatch(path.name), path) for path in folder.glob("step_*.pt")]
    return sorted((int(match[1]), path) for match, path in matches if match)


def load_latest(folder: str | os.PathLike[str]) -> tuple[int, State] | None:
    """Reads the newest intact checkpoint, and logs a warning for each damaged one that is newer.

    Returns:
        Its step and its state, with tensors on the CPU; None if there is no checkpoint.

    Raises:
        CheckpointError: if all checkpoints are damaged, or if the newest intact one was written by
            another version or holds more than plain data.
        StorageError: if a file cannot be read.
    """
    files = checkpoint_files(Path(folder))
    for _, path in reversed(files):
        try:
            return load_checkpoint(path)
        except _DamagedError as error:
            _LOG.warning("%s; trying the one before", error)
    if files:
        raise CheckpointError(f"none of the {len(files)} checkpoints in {folder} is intact")
    return None


def load_checkpoint(path: str | os.PathLike[str]) -> tuple[int, State]:
    """Reads one checkpoint.

    Returns:
        Its step and its state, with tensors on the CPU.

    Raises:
        CheckpointError: if the file is damaged, was written by a version with another format, or
            holds more than plain data, so that reading it could run code.
        StorageError: if the file cannot be read.
    """
    path = Path(path)
    with storage(path, "read"):
        content = path.read_bytes()
    digest, _, body = content.partition(b"\n")
    if digest != hashlib.sha256(body).hexdigest().encode():
        raise _DamagedError(
            f"the checkpoint {path} is damaged ({len(content)} bytes, wrong checksum)"
        )
    line, _, payload = body.partition(b"\n")
    try:
        header = json.loads(line)
        version, step = int(header["format"]), int(header["step"])
        if version == FORMAT:
            return step, torch.load(io.BytesIO(payload), map_location="cpu", weights_only=True)
    except Exception as error:  # torch's own text advises to run the code that may be in the file
        raise CheckpointError(
            f"{path} is not a checkpoint of proposer_rl: it must hold only tensors and plain data"
        ) from error
    raise CheckpointError(
        f"the checkpoint {path} has format {version}, this version of proposer_rl reads only "
        f"format {FORMAT}: go on with the version that wrote it, or start in another folder"
    )


def learnt_curriculum(path: Path) -> State:
    """Reads the state of a trained curriculum.

    Args:
        path: a checkpoint, a ``proposer.pt``, or a run's folder, whose newest checkpoint is read.
            Of several seeds the state of the first is returned.

    Raises:
        CheckpointError: if there is none, or it cannot be used.
        StorageError: if it cannot be read.
    """
    latest = load_latest(path / "checkpoints") if path.is_dir() else load_checkpoint(path)
    if latest is None and (path / PROPOSER).exists():
        latest = load_checkpoint(path / PROPOSER)
    if latest is None:
        raise CheckpointError(f"the folder holds no checkpoints and no {PROPOSER}")
    state = latest[1]
    learnt: State = state["curricula"][0] if "curricula" in state else state["curriculum"]
    return learnt


def _plain(value: object, where: str) -> object:
    """Copies a state, and refuses values that ``weights_only=True`` could not load."""
    if isinstance(value, torch.Tensor):
        # A clone, since for a view torch.save would write the whole storage behind it.
        return value.detach().cpu().clone()
    if isinstance(value, dict):
        return {
            _plain(k, f"a key of {where}"): _plain(v, f"{where}[{k!r}]") for k, v in value.items()
        }
    if type(value) is list or type(value) is tuple:
        items = [_plain(v, f"{where}[{i}]") for i, v in enumerate(value)]
        return items if type(value) is list else tuple(items)
    if type(value) in _PLAIN:
        return value
    raise CheckpointError(
        f"{where} is a {type(value).__name__}; a checkpoint can hold dicts, lists, tuples, "
        "tensors, numbers, texts and None"
    )
