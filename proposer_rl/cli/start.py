"""What ``bin/train`` and ``proposer-train`` start: help at once, everything else with PyTorch."""

from __future__ import annotations

import os
import sys

from proposer_rl.cli.errors import print_all_signs
from proposer_rl.cli.help import help_text


def main() -> None:
    """Prints the help, or runs the command."""
    if {"--help", "-h"} & set(sys.argv[1:]):
        print_all_signs()
        try:
            print(help_text(sys.argv[1:]), flush=True)
        except BrokenPipeError:  # who reads has seen enough, as with `| head`
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return
    # It takes seconds to import PyTorch.
    from proposer_rl.cli.train import main as train

    train()


if __name__ == "__main__":
    sys.argv[0] = "train"  # the name in the shell, bin/train: Hydra installs completion for it
    main()
