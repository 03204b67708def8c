"""Packages that are too heavy for the tests' environment, as they are in the registry."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path

import pytest

Install = Callable[..., Path]
LOADERS = (  # accelerate and what it needs
    "accelerate==1.15.0 huggingface-hub==2.4.0 safetensors==0.8.0 psutil==7.2.2 hf-xet==1.8.0 "
    "httpx2==2.16.2 httpcore2==2.16.2 truststore==0.10.5 typer==0.29.2 shellingham==1.5.4"
)


@pytest.fixture(scope="session")
def install(tmp_path_factory: pytest.TempPathFactory) -> Install:
    """Installs packages, one after another in a text, without what they require; returns a folder.

    ``python`` is the version that a wheel is for, where it is not this one. A test is skipped where
    pip cannot install them, as without a network.
    """

    @cache
    def installed(requirements: str, python: str | None = None) -> Path:
        # dill, of which datasets makes use, takes modules for parts of a script elsewhere.
        folder = tmp_path_factory.mktemp("registry") / "site-packages"
        options = ["--python-version", python, "--only-binary=:all:"] if python else []
        pip = [sys.executable, "-m", "pip", "install", "--no-deps", "--quiet", *options]
        done = subprocess.run(
            [*pip, "--target", folder, *requirements.split()],
            capture_output=True,
            text=True,
            check=False,
        )
        if done.returncode:
            reason = (done.stderr.strip() or "no pip").splitlines()[-1]
            pytest.skip(f"cannot install {requirements.split()[0]}: {reason}")
        return folder

    return installed
