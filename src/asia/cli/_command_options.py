"""Options of the agent `command:NAME`."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from asia.cli._driver import Driver

if TYPE_CHECKING:
    from asia.drive.command import CommandRules

PREFIX = "command:"
_OTHERS = ("llm", "mcp", "workspace")
PANEL = "Agent command:NAME (claude, codex, gemini, or a program of your own)"

Command = Annotated[
    str | None,
    typer.Option(
        help="Command line of an agent of your own, with {prompt} or {prompt_file} in it.",
        rich_help_panel=PANEL,
    ),
]
Minutes = Annotated[
    float | None,
    typer.Option("--agent-minutes", help="Most minutes of one sitting.", rich_help_panel=PANEL),
]
StuckMinutes = Annotated[
    float,
    typer.Option(help="Stop it after so many without a new experiment.", rich_help_panel=PANEL),
]
Network = Annotated[
    bool,
    typer.Option(
        "--network", help="Let it reach the network, which hosted models need.",
        rich_help_panel=PANEL,
    ),
]  # fmt: skip
Configs = Annotated[
    list[Path] | None,
    typer.Option(
        "--agent-config", help="Folder or file of its own, such as ~/.claude; it gets a copy.",
        rich_help_panel=PANEL,
    ),
]  # fmt: skip
Mounts = Annotated[
    list[Path] | None,
    typer.Option(
        "--agent-mount", help="Folder to show it, read-only, such as where it is installed.",
        rich_help_panel=PANEL,
    ),
]  # fmt: skip
PassEnv = Annotated[
    list[str] | None,
    typer.Option(help="Environment variable to pass on, such as its key.", rich_help_panel=PANEL),
]


def command_driver(
    agent: str,
    command: str | None,
    *,
    minutes: float | None,
    stuck_minutes: float,
    tokens: int | None,
    cost: float | None,
    network: bool,
    configs: list[Path] | None,
    mounts: list[Path] | None,
    pass_env: list[str] | None,
    model: str | None,
) -> Driver:
    """The program, its rules and its jail. Raises UserError for what is not there, and for a cap
    that cannot be kept."""
    from asia.agents import AGENTS
    from asia.drive.command import CommandRules, check_rules, make_preset, run_command
    from asia.errors import UserError
    from asia.sandbox import Isolation, probe

    name = agent.removeprefix(PREFIX)
    if not name.replace("-", "").isalnum():
        raise UserError(f"--agent {agent}: expected command:NAME with letters and digits")
    if name in {*AGENTS, *_OTHERS}:
        raise UserError(
            f"--agent {agent}: '{name}' is another way to drive a search; choose a name of your own"
        )
    preset = make_preset(name, command)
    _check_given((*(configs or ()), *(mounts or ())), pass_env or ())
    rules = CommandRules(
        minutes=minutes,
        tokens=tokens,
        cost=cost,
        stuck_minutes=stuck_minutes,
        network=network,
        mounts=tuple(p.expanduser().resolve() for p in mounts or ()),
        # Not resolved: a link keeps its own name below the agent's home.
        configs=tuple(Path(os.path.abspath(p.expanduser())) for p in configs or ()),
        variables=(*preset.keys, *(pass_env or ())),
        jail=probe().level is Isolation.NAMESPACE,
        model=model,
    )
    check_rules(preset, rules)
    return Driver(
        name,
        lambda ready, on_event, on_start: run_command(ready, preset, rules, on_event, on_start),
        _settings(command or name, rules),
        (_jail_words(name, rules),),
    )


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
