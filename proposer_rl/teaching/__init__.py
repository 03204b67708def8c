"""Curricula in your own training loop: teachers, spaces of levels, and wrappers of libraries."""

from proposer_rl.tasks.ranges import Log as Log
from proposer_rl.teaching.gymnasium import TaughtEnv as TaughtEnv
from proposer_rl.teaching.remote import TeacherClient as TeacherClient
from proposer_rl.teaching.robots import LevelTerm as LevelTerm
from proposer_rl.teaching.robots import TaughtRunner as TaughtRunner
from proposer_rl.teaching.sampler import TeacherSampler as TeacherSampler
from proposer_rl.teaching.spaces import Items as Items
from proposer_rl.teaching.spaces import LevelGenerator as LevelGenerator
from proposer_rl.teaching.spaces import LevelSpace as LevelSpace
from proposer_rl.teaching.spaces import MadeLevels as MadeLevels
from proposer_rl.teaching.spaces import Parameters as Parameters
from proposer_rl.teaching.teacher import Teacher as Teacher
from proposer_rl.teaching.torchrl import LevelTransform as LevelTransform
