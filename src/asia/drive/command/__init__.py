"""Coding agents that run as commands: in a jail, capped, resumed."""

from asia.drive.command.access import Access
from asia.drive.command.jailed import check_jail, run_jailed
from asia.drive.command.presets import PRESETS, Preset, filled, make_preset
from asia.drive.command.rules import CommandRules, check_rules
from asia.drive.command.run import CommandAgent, command_agent, run_command, search_beside
from asia.drive.command.stream import Stream, StreamFormat

__all__ = [
    "PRESETS",
    "Access",
    "CommandAgent",
    "CommandRules",
    "Preset",
    "Stream",
    "StreamFormat",
    "check_jail",
    "check_rules",
    "command_agent",
    "filled",
    "make_preset",
    "run_command",
    "run_jailed",
    "search_beside",
]
