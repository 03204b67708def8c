"""The base of tasks, and the interfaces of their parts."""

from proposer_rl.task.base import Task as Task
from proposer_rl.task.protocols import Board as Board
from proposer_rl.task.protocols import CellKind as CellKind
from proposer_rl.task.protocols import ComputeContext as ComputeContext
from proposer_rl.task.protocols import DifferentiableTask as DifferentiableTask
from proposer_rl.task.protocols import Distribution as Distribution
from proposer_rl.task.protocols import EditableTask as EditableTask
from proposer_rl.task.protocols import LevelResult as LevelResult
from proposer_rl.task.protocols import Levels as Levels
from proposer_rl.task.protocols import LocatedTarget as LocatedTarget
from proposer_rl.task.protocols import NoSuccessError as NoSuccessError
from proposer_rl.task.protocols import OptimalTask as OptimalTask
from proposer_rl.task.protocols import PlayableTask as PlayableTask
from proposer_rl.task.protocols import Space as Space
from proposer_rl.task.protocols import check_distributions as check_distributions
from proposer_rl.task.protocols import for_copies as for_copies
from proposer_rl.task.protocols import level_inputs as level_inputs
from proposer_rl.task.protocols import nearest_bins as nearest_bins
from proposer_rl.task.protocols import refuse_unfit_bins as refuse_unfit_bins
from proposer_rl.task.protocols import space_features as space_features
