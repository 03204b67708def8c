"""Where the package and its configuration lie, and the groups in it; imports nothing slow."""

from __future__ import annotations

from proposer_rl.recipes import CONFIG_FOLDER as CONFIG_FOLDER
from proposer_rl.recipes import PACKAGE as PACKAGE

# In the order in which they are given on the command line, and what each decides.
GROUPS = {
    "task=": "what is to be learnt",
    "+method=": "what the Solver trains on",
    "+scale=": "how much is computed",
    "+as=": "the numbers of another library, for methods that keep levels",
    "+score=": "where the scores of levels come from",
    "+filter=": "which of more levels are trained on",
    "+source=": "what knows the Solver's performance",
    "+ablation=": "what is changed of a method",
    "+sweep=": "many runs",
}
# Of these nothing is chosen until a command does.
ADDED = [group.strip("+=") for group in GROUPS if group.startswith("+")]
# And these change a method or a scale, which therefore come before them.
CHANGING = [f"+{group}" for group in ADDED if group not in ("method", "scale", "sweep")]
