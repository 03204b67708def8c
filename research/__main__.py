"""``bin/research NAME ...``: starts the instrument of that name, ``python -m research.NAME``."""

from __future__ import annotations

import sys
from importlib import import_module

NAMES = {
    "snr": "the signal-to-noise ratio of a Proposer's reward",
    "foresight": "how far ahead first-order gain predicts gains",
    "conditioning": "whether a Proposer conditions on the Solver",
    "intervals": "how often intervals over few seeds hold what they are of",
    "slurm": "runs under a real Slurm of one node: time-outs, preemption, scancel",
    "prompts": "curricula of prompts for tiny language models, at equal rollouts",
    "loops": "curricula in training loops of stock parts",
    "scores": "finished runs on further levels, as a table of methods",
    "pages": "the pages of a study: which curriculum to use, and which claims hold",
}


def main() -> None:
    """Start the instrument that the first argument names; its own arguments follow."""
    name = sys.argv[1] if len(sys.argv) > 1 else ""
    if name in ("", "-h", "--help"):
        print("usage: bin/research NAME ...\n")
        print(*(f"  {known:13} {about}" for known, about in NAMES.items()), sep="\n")
        return
    if name not in NAMES:
        print(f"error: {name}: must be one of {', '.join(NAMES)}", file=sys.stderr)
        sys.exit(2)
    sys.argv = [f"bin/research {name}", *sys.argv[2:]]
    import_module(f"research.{name}").main()


if __name__ == "__main__":
    main()
