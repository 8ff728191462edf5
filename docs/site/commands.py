"""The command-line page, made from the commands themselves."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

import typer

from asia.interfaces.cli import app

VALUES = {str: "TEXT", int: "N", float: "NUMBER", Path: "PATH"}
INTRODUCTION = """# Commands

Ten commands take a problem from its records to a model in use: `init`, `check`, `run`, `status`,
`show`, `validate`, `report`, `unseal`, `export` and `view`. `asia COMMAND --help-all` prints the
text of this page; `asia COMMAND --help` leaves rare options out.

**RUN** is the path of a run, its name, or left out for the newest. **PROBLEM** is a built-in name
or a directory with `problem.toml`.

| exit code | meaning |
|---|---|
| 0 | done |
| 1 | a fault of ASIA or its sandbox, or a check that failed |
| 2 | an error that you can correct: the message explains it |
| 3 | the search is finished and no candidate has a score |
| 130, 143 | interrupted, terminated: the same command continues |
"""


def commands_page() -> str:
    """Every command with its arguments and options, as Markdown."""
    group: Any = typer.main.get_command(app)
    return "\n".join([INTRODUCTION, *_commands(group, "")])


def _commands(group: Any, prefix: str) -> Iterator[str]:
    """Sections of the commands of a group, and of the groups in it."""
    found = [(name, group.get_command(None, name)) for name in group.list_commands(None)]
    for name, command in sorted(found, key=lambda c: hasattr(c[1], "commands")):
        if hasattr(command, "commands"):
            yield from _commands(command, f"{prefix}{name} ")
        else:
            yield _command(f"{prefix}{name}", command)


def _command(name: str, command: Any) -> str:
    panels: dict[str, list[Any]] = {}
    for option in command.params:
        if option.param_type_name == "option" and option.name != "help_all":
            panels.setdefault(option.rich_help_panel or "", []).append(option)
    arguments = [p for p in command.params if p.param_type_name == "argument" and not p.hidden]
    words = " ".join(_argument_name(a) for a in arguments)
    text = [f"## asia {name}\n", f"```\nasia {name} [OPTIONS] {words}".rstrip() + "\n```\n"]
    text.append(re.sub(r"(?<!\n)\n(?!\n)", " ", (command.help or "").strip()) + "\n")
    if arguments:
        text.append(_table("argument", [(f"`{_argument_name(a)}`", a) for a in arguments]))
    for title, options in panels.items():
        text += [f"**{title}**\n"] if title else []
        text.append(_table("option", [(_option_name(o), o) for o in options]))
    return "\n".join(text)


def _argument_name(argument: Any) -> str:
    name = argument.metavar or argument.name.upper()
    return name if argument.required or name.startswith("[") else f"[{name}]"


def _option_name(option: Any) -> str:
    names = ", ".join(f"`{word}`" for word in option.opts)
    return names if option.is_flag else f"{names} `{_value(option)}`"


def _value(option: Any) -> str:
    if option.metavar:
        return str(option.metavar)
    kind = option.type_descriptor.annotation
    if kind in VALUES:
        return VALUES[kind]
    inner = get_args(kind)
    return "...".join([VALUES[inner[0]], ""]) if inner and inner[0] in VALUES else "VALUE"


def _table(head: str, rows: list[tuple[str, Any]]) -> str:
    lines = [f"| {head} | meaning |", "|---|---|"]
    for name, parameter in rows:
        notes = [" ".join((parameter.help or "").split())]
        if parameter.param_type_name == "option" and parameter.envvar:
            notes.append(f"Environment variable: `{parameter.envvar}`.")
        if parameter.default not in (None, False, (), []) and not callable(parameter.default):
            notes.append(f"Default: `{parameter.default}`.")
        meaning = " ".join(notes).replace("<", "&lt;").replace("|", "\\|")
        lines.append(f"| {name} | {meaning} |")
    return "\n".join(lines) + "\n"
