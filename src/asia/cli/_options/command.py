"""Options of the agent `command:NAME`."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from asia.cli._driver import Driver
from asia.cli._options.llm import ModelOptions

if TYPE_CHECKING:
    from asia.drive.command import CommandRules

PREFIX = "command:"
_option = partial(
    typer.Option,
    rich_help_panel="Agent command:NAME (claude, codex, gemini, or a program of your own)",
)


@dataclass(frozen=True)
class CommandOptions:
    """How a coding agent is started, and what it may use."""

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
    network: Annotated[
        bool, _option("--network", help="Allow network access, which hosted models need.")
    ] = False
    agent_config: Annotated[
        list[Path] | None,
        _option(
            help="Configuration folder or file of the agent, such as ~/.claude; it gets a copy."
        ),
    ] = None
    agent_mount: Annotated[
        list[Path] | None,
        _option(help="Folder that the agent may read, such as its installation."),
    ] = None
    pass_env: Annotated[
        list[str] | None,
        _option(help="Environment variable to pass to the agent, such as its key."),
    ] = None

    def driver(self, agent: str, caps: ModelOptions) -> Driver:
        """The program, its rules and its jail. Raises UserError for what is not there, and for a
        cap that cannot be kept."""
        from asia.drive.command import check_rules, make_preset, run_command

        name = _name(agent)
        preset = make_preset(name, self.command)
        rules = self._rules(preset.keys, caps)
        check_rules(preset, rules)
        return Driver(
            name,
            lambda ready, on_event, on_start: run_command(ready, preset, rules, on_event, on_start),
            _settings(self.command or name, rules),
            (_jail_words(name, rules),),
        )

    def _rules(self, keys: tuple[str, ...], caps: ModelOptions) -> CommandRules:
        from asia.drive.command import CommandRules
        from asia.sandbox import Jail

        configs, mounts = self.agent_config or (), self.agent_mount or ()
        _check_given((*configs, *mounts), self.pass_env or ())
        return CommandRules(
            minutes=self.agent_minutes,
            tokens=caps.max_tokens,
            cost=caps.max_cost,
            stuck_minutes=self.stuck_minutes,
            network=self.network,
            mounts=tuple(p.expanduser().resolve() for p in mounts),
            # Not resolved: a link keeps its own name below the agent's home.
            configs=tuple(Path(os.path.abspath(p.expanduser())) for p in configs),
            variables=(*keys, *(self.pass_env or ())),
            jail=Jail.why_not() is None,
            model=caps.model,
        )


def _name(agent: str) -> str:
    """NAME of `command:NAME`. Raises UserError for one that is taken or is none."""
    from asia.agents import RESERVED
    from asia.errors import UserError

    name = agent.removeprefix(PREFIX)
    if not name.replace("-", "").isalnum():
        raise UserError(f"--agent {agent}: expected command:NAME with letters and digits")
    if name in RESERVED:
        raise UserError(
            f"--agent {agent}: '{name}' is another way to drive a search; choose a name of your own"
        )
    return name


def _settings(command: str, rules: CommandRules) -> dict[str, str]:
    """For the ledger."""
    return {
        "command": command,
        "model": rules.model or "its default",
        "jail": "namespace" if rules.jail else "none",
        "network": "yes" if rules.network else "no",
        "mounts": _names(rules.mounts),
        "configs": _names(rules.configs),
    }


def _names(paths: Sequence[Path]) -> str:
    home = str(Path.home())
    return ", ".join(re.sub(f"^{re.escape(home)}(?=/|$)", "~", str(p)) for p in paths) or "none"


def _check_given(paths: Sequence[Path], variables: Sequence[str]) -> None:
    from asia.errors import UserError

    for path in paths:
        if not path.expanduser().exists():
            raise UserError(f"{path} does not exist: give a folder or file that does")
    for variable in variables:
        if variable not in os.environ:
            raise UserError(f"--pass-env {variable}: it is not set; export it first")


def _jail_words(name: str, rules: CommandRules) -> str:
    """What holds the agent, for people."""
    if not rules.jail:
        return (
            f"agent {name}: no jail (level process). It can read what you can: other runs, test "
            "files that lie open, your keys. Its score still comes from the evaluator alone. "
            "Install bubblewrap for a jail."
        )
    network = "the network" if rules.network else "no network (hosted models need --network)"
    shown = ", ".join(str(p) for p in (*rules.mounts, *rules.configs)) or "nothing else of yours"
    return f"agent {name}: in a jail (level namespace) with its workspace, {network}, {shown}"
