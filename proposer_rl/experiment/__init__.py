"""The outer loop: a Solver, a curriculum and a budget become a folder of measurements."""

from proposer_rl.experiment.loop import Experiment as Experiment
from proposer_rl.experiment.loop import ScheduleSettings as ScheduleSettings
from proposer_rl.experiment.loop import check_headline as check_headline
from proposer_rl.experiment.tables import Log as Log
