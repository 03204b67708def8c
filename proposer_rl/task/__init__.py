"""Tasks: what they are made of, and the base of all."""

from proposer_rl.task.base import Task as Task
from proposer_rl.task.base import check_names as check_names
from proposer_rl.task.base import distribution_of as distribution_of
from proposer_rl.task.base import for_copies as for_copies
from proposer_rl.task.base import named as named
from proposer_rl.task.base import refuse_single_bin as refuse_single_bin
from proposer_rl.task.contract import Board as Board
from proposer_rl.task.contract import CellKind as CellKind
from proposer_rl.task.contract import ComputeContext as ComputeContext
from proposer_rl.task.contract import DifferentiableTask as DifferentiableTask
from proposer_rl.task.contract import Distribution as Distribution
from proposer_rl.task.contract import EditableTask as EditableTask
from proposer_rl.task.contract import EnumerableTask as EnumerableTask
from proposer_rl.task.contract import EpisodeLaw as EpisodeLaw
from proposer_rl.task.contract import LevelResult as LevelResult
from proposer_rl.task.contract import Levels as Levels
from proposer_rl.task.contract import LocatedTarget as LocatedTarget
from proposer_rl.task.contract import NoSuccessError as NoSuccessError
from proposer_rl.task.contract import OptimalTask as OptimalTask
from proposer_rl.task.contract import PlayableTask as PlayableTask
from proposer_rl.task.contract import Space as Space
from proposer_rl.task.features import space_features as space_features
