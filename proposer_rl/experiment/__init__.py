"""The outer loop: a Solver, a curriculum and a budget become a folder of measurements."""

from proposer_rl.experiment.loop import Experiment
from proposer_rl.experiment.schedule import ScheduleSettings, check_headline
from proposer_rl.experiment.tables import Log

__all__ = ["Experiment", "Log", "ScheduleSettings", "check_headline"]
