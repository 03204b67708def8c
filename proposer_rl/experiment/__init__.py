"""The outer loop: trains Solvers on curricula, and writes a folder of measurements."""

from proposer_rl.experiment.loop import Experiment as Experiment
from proposer_rl.experiment.loop import ScheduleSettings as ScheduleSettings
from proposer_rl.experiment.loop import check_headline as check_headline
from proposer_rl.experiment.tables import Log as Log
