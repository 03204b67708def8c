"""What is asked of this project's own runs. It is not in the wheel; nothing there imports it."""

import proposer_rl.cli  # noqa: F401  sets how threads wait, before PyTorch is loaded
