"""What ``bin/train`` and ``proposer-train`` start: help at once, everything else with PyTorch."""

from __future__ import annotations

import os
import sys
from importlib.util import find_spec
from typing import Any, cast

from proposer_rl.cli.help import asks_for_help, help_text


def hide_what_is_not_there() -> None:
    """Let pandas stay missing in this process where it is missing now.

    At the output of any module tensordict imports it as soon as it can be found, so that pandas
    half-way through an installation beside a run, as bin/test's is, would end the run.
    """
    if find_spec("pandas") is None:
        cast(dict[str, Any], sys.modules)["pandas"] = None


def main() -> None:
    """Entry point of the command."""
    if asks_for_help(sys.argv[1:]):
        try:
            print(help_text(sys.argv[1:]), flush=True)
        except BrokenPipeError:  # who reads has seen enough, as with `| head`
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return
    hide_what_is_not_there()
    # It takes seconds to import PyTorch.
    from proposer_rl.cli.train import main as train

    train()


if __name__ == "__main__":
    sys.argv[0] = "train"  # the name in the shell, bin/train: Hydra installs completion for it
    main()
