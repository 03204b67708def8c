"""What ``bin/train`` and ``proposer-train`` start: help at once, everything else with PyTorch."""

from __future__ import annotations

import sys

from proposer_rl.cli.help import asks_for_help, help_text


def main() -> None:
    """Entry point of the command."""
    if asks_for_help(sys.argv[1:]):
        print(help_text(sys.argv[1:]))
        return
    # It takes seconds to import PyTorch.
    from proposer_rl.cli.train import main as train

    train()


if __name__ == "__main__":
    sys.argv[0] = "train"  # the name in the shell, bin/train: Hydra installs completion for it
    main()
