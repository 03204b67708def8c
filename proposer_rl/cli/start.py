"""Starts ``bin/train`` and ``proposer-train``; help is printed without importing PyTorch."""

from __future__ import annotations

import sys

from proposer_rl.cli.help import help_text
from proposer_rl.runs.process import guard_output


def main() -> None:
    """Prints the help, or runs the command."""
    if {"--help", "-h"} & set(sys.argv[1:]):
        guard_output()
        print(help_text())
        return
    # It takes seconds to import PyTorch.
    from proposer_rl.cli.train import main as train

    train()


if __name__ == "__main__":
    sys.argv[0] = "train"  # the command for which Hydra installs completion, of bin/train
    main()
