"""Options of the agent `command:NAME`."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Annotated

import typer

from asia.cli._driver import Driver
from asia.cli._options.jail import JailOptions, access_settings, jail_words
from asia.cli._options.llm import ModelOptions

if TYPE_CHECKING:
    from asia.drive.command import CommandRules

PREFIX = "command:"
_option = partial(
    typer.Option,
    rich_help_panel="Agent command:NAME (claude, codex, gemini, or a program of your own)",
)


@dataclass(frozen=True)
class CommandOptions(JailOptions):
    """Command line, limits and access of a coding agent."""

    command: Annotated[
        str | None,
        _option(help="Command line of your own agent, with {prompt} or {prompt_file} in it."),
    ] = None
    agent_minutes: Annotated[
        float | None, _option(help="Stop the agent this many minutes after this command starts.")
    ] = None
    stuck_minutes: Annotated[
        float, _option(help="Stop the agent after this many minutes without a new experiment.")
    ] = 30.0

    def driver(self, agent: str, caps: ModelOptions) -> Driver:
        """Make the driver: program, rules and jail. Raises UserError for a missing program, and for
        a limit that cannot be enforced."""
        from asia.drive.command import check_rules, command_agent, make_preset

        name = _name(agent)
        preset = make_preset(name, self.command)
        rules = self._rules(preset.keys, caps)
        check_rules(preset, rules)
        return Driver(
            name,
            lambda ready, leg: command_agent(ready, preset, rules, leg),
            _settings(self.command or name, rules),
            (_jail_words(name, rules),),
        )

    def _rules(self, keys: tuple[str, ...], caps: ModelOptions) -> CommandRules:
        from asia.drive.command import CommandRules
        from asia.sandbox import Jail

        access = self.access(keys)
        return CommandRules(
            minutes=self.agent_minutes,
            tokens=caps.max_tokens,
            cost=caps.max_cost,
            stuck_minutes=self.stuck_minutes,
            network=access.network,
            mounts=access.mounts,
            configs=access.configs,
            variables=access.variables,
            jail=Jail.why_not() is None,
            model=caps.model,
        )


def _name(agent: str) -> str:
    """Return NAME of `command:NAME`. Raises UserError if it is reserved or invalid."""
    from asia.agents import RESERVED
    from asia.errors import UserError

    name = agent.removeprefix(PREFIX)
    if not name.replace("-", "").isalnum():
        raise UserError(f"--agent {agent}: expected command:NAME with letters and digits")
    if name in RESERVED:
        raise UserError(f"--agent {agent}: '{name}' is reserved; choose another name")
    return name


def _settings(command: str, rules: CommandRules) -> dict[str, str]:
    """Return the settings for the ledger."""
    return {
        "command": command,
        "model": rules.model or "its default",
        "jail": "namespace" if rules.jail else "none",
        **access_settings(rules),
    }


def _jail_words(name: str, rules: CommandRules) -> str:
    """Return a sentence on the isolation of the agent."""
    if not rules.jail:
        return (
            f"agent {name}: no jail (level process). It can read all your files: other runs, "
            "unsealed test files, keys. Its score still comes only from the evaluator. "
            "Install bubblewrap for a jail."
        )
    return f"agent {name}: {jail_words(rules)}"
