"""Loading and making problems: built-in ones by name, a user's by path, a run's from its lock."""

from asia.data._digest import data_digest
from asia.data._store import key_folder
from asia.data.intake.sheet import Wanted
from asia.problem._check import CheckReport, check_problem
from asia.problem._digest import protocol_digest
from asia.problem._load import builtin_problems, load_lock, load_problem, read_records
from asia.problem._lock import Difference, lock_differences, lock_text
from asia.problem._problem import Problem, Seal, kept_places, record_places
from asia.problem._protocol import check_feedback
from asia.problem._training import training_text
from asia.problem.new.init import NewProblem, init_problem
from asia.problem.new.preparing import Preparation

__all__ = [
    "CheckReport",
    "Difference",
    "NewProblem",
    "Preparation",
    "Problem",
    "Seal",
    "Wanted",
    "builtin_problems",
    "check_feedback",
    "check_problem",
    "data_digest",
    "init_problem",
    "kept_places",
    "key_folder",
    "load_lock",
    "load_problem",
    "lock_differences",
    "lock_text",
    "protocol_digest",
    "read_records",
    "record_places",
    "training_text",
]
