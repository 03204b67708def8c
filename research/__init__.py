"""What is asked of this project's own runs. It is not in the wheel; nothing there imports it."""
