"""Levels of isolation, one a file."""

from asia.judge.sandbox.level import Level
from asia.judge.sandbox.levels.landlock import Landlock
from asia.judge.sandbox.levels.namespace import Namespace
from asia.judge.sandbox.levels.process import Process
from asia.judge.sandbox.levels.sandbox_exec import SandboxExec
from asia.judge.sandbox.types import Isolation

LEVELS: dict[Isolation, Level] = {
    level.isolation: level for level in (Namespace(), Landlock(), SandboxExec(), Process())
}
"""All of them by name, strongest first."""
