"""Levels of isolation, one a file."""

from __future__ import annotations

from asia.sandbox._level import Level
from asia.sandbox._types import Isolation
from asia.sandbox.levels.landlock import Landlock
from asia.sandbox.levels.namespace import Namespace
from asia.sandbox.levels.process import Process
from asia.sandbox.levels.sandbox_exec import SandboxExec

LEVELS: dict[Isolation, Level] = {
    level.isolation: level for level in (Namespace(), Landlock(), SandboxExec(), Process())
}
"""All of them by name, strongest first."""
