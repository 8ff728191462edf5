"""Coding agents that run as commands: in a jail, capped, resumed."""

from asia.drive.command.presets import PRESETS, Preset, filled, make_preset
from asia.drive.command.rules import CommandRules, check_rules
from asia.drive.command.run import run_command
from asia.drive.command.stream import Stream, StreamFormat

__all__ = [
    "PRESETS",
    "CommandRules",
    "Preset",
    "Stream",
    "StreamFormat",
    "check_rules",
    "filled",
    "make_preset",
    "run_command",
]
