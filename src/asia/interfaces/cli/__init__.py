"""The command line: parse, call the library, exit code.

Exit codes: 0 done; 1 a bug, a broken sandbox or a failed check; 2 an error that the user can
correct; 3 a search whose candidates all failed; 130 interrupted (SIGINT), 143 terminated (SIGTERM).
"""

import inspect
import re
import signal
import sys
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from types import FrameType
from typing import Any, NoReturn, cast

import typer
from typer.core import TyperGroup

from asia._diagnostic import error_sentence
from asia._plugins import Part, ordered, parts_of
from asia._text import say
from asia.errors import CandidateError, SandboxError, UserError
from asia.interfaces.cli import agent as _agent
from asia.interfaces.cli import bench as _bench
from asia.interfaces.cli import check as _check
from asia.interfaces.cli import (
    demo,
    doctor,
    export,
    extend,
    init,
    linear,
    models,
    query,
    report,
    show,
    status,
    steer,
    unseal,
    validate,
    verify,
    view,
)
from asia.interfaces.cli import run as _run
from asia.interfaces.cli.options import AddedOptions, Command, with_groups

__all__ = ["app", "main"]

INTERRUPTED = 130
TERMINATED = 128 + signal.SIGTERM
PLUGINS = "asia.commands"


class Commands(TyperGroup):
    """The commands of this package and of plug-ins, each made when it is asked for."""

    def list_commands(self, ctx: Any) -> list[str]:
        """List the names, plug-ins last that have no place of their own; without plug-ins whose
        names clash, see `asia doctor`."""
        names, others = [*MAIN_COMMANDS, *MORE_COMMANDS], list[Part]()
        with suppress(UserError):
            others = [part for part in parts_of(PLUGINS) if part.name not in names]
        return ordered(names, {p.name: getattr(_loaded(p), "after", None) for p in others})

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """Return the command, from a plug-in if it is none of this package; None if there is
        none."""
        run, panel = MAIN_COMMANDS.get(cmd_name), None
        if run is None:
            run, panel = MORE_COMMANDS.get(cmd_name), "More commands"
        if run is None:
            part = next((part for part in parts_of(PLUGINS) if part.name == cmd_name), None)
            if part is None:
                return None
            run, panel = _loaded(part), f"Commands of {part.package}"
            if isinstance(run, Command):
                run, panel = run.run, None
        # A group of one command stays a group.
        make = typer.main.get_group if isinstance(run, typer.Typer) else typer.main.get_command
        if not isinstance(run, typer.Typer):
            own, run = run, typer.Typer(add_completion=False, rich_markup_mode="markdown")
            prints = _on_terminal if own in _SEARCHES else partial(bool, own in _PRINTING)
            run.command()(
                with_groups(
                    own, _BRIEF_HELP.get(own), prints_progress=prints, added=_added(cmd_name)
                )
            )
        command: Any = make(run)
        command.name, command.rich_help_panel = cmd_name, panel
        return command


def _group(text: str, group: type[TyperGroup] = TyperGroup) -> typer.Typer:
    return typer.Typer(
        cls=group,
        help=text,
        no_args_is_help=True,
        add_completion=False,
        pretty_exceptions_enable=False,
        rich_markup_mode="markdown",
    )


app = _group(
    "Identify a dynamical system from measured records: search for models, score them by "
    "open-loop simulation, and return a model with the evidence for it.",
    Commands,
)
app.info.name = "asia"
agent_app = _group("Connect a coding agent or a language model, or work by hand in a workspace.")
bench_app = _group("Compare agents.")

MAIN_COMMANDS: dict[str, Callable[..., None]] = {
    "init": init.init,
    "check": _check.check,
    "run": _run.run,
    "status": status.status,
    "show": show.show,
    "validate": validate.validate,
    "report": report.report,
    "unseal": unseal.unseal,
    "linear": linear.linear,
    "extend": extend.extend,
    "export": export.export,
    "view": view.view,
}
MORE_COMMANDS: dict[str, Callable[..., None] | typer.Typer] = {
    "steer": steer.steer,
    "note": steer.note,
    "verify": verify.verify,
    "query": query.query,
    "agent": agent_app,
    "bench": bench_app,
    "doctor": doctor.doctor,
    "models": models.models,
    "demo": demo.demo,
    "try": _agent.try_,
}
_AGENT: dict[str, Callable[..., None]] = {
    "workspace": _agent.workspace,
    "try": _agent.try_,
    "mcp": _agent.mcp,
    "config": _agent.mcp_config,
    "check": _agent.llm_check,
}
_BENCH: dict[str, Callable[..., None]] = {
    "agents": _bench.compare_agents,
}
_BRIEF_HELP = {
    _run.run: _run.BRIEF_HELP,
    init.init: init.BRIEF_HELP,
    _agent.workspace: _agent.BRIEF_HELP,
}
"""Options that `--help` of a command shows; `--help-all` shows the others too. Without an entry
here `--help` shows all."""
_PRINTING = (view.view, demo.demo, doctor.doctor, _agent.try_)
"""Commands that print their own progress, or wait for others."""
_SEARCHES = (_run.run, extend.extend)
"""Commands that draw their own progress on a terminal."""


def _on_terminal() -> bool:
    return sys.stdout.isatty()


for _app, _commands in ((agent_app, _AGENT), (bench_app, _BENCH)):
    for _name, _command in _commands.items():
        _shown = with_groups(_command, _BRIEF_HELP.get(_command), prints_progress=lambda: True)
        _app.command(_name)(_shown)


def _loaded(part: Part) -> Command | Callable[..., None] | typer.Typer:
    """Load the command of a plug-in; one that does not load becomes a command that says so."""
    try:
        loaded = part.load()
        if isinstance(loaded, Command | typer.Typer) or inspect.isfunction(loaded):
            return loaded
        raise UserError(
            f"command {part.name} of package {part.package}: expected a typer.Typer or a "
            f"function, got {type(loaded).__name__}"
        )
    except UserError as error:
        reason = error

        def broken() -> None:
            """Does not load; `asia doctor` gives the reason."""
            raise reason

        return broken


def _added(name: str) -> list[AddedOptions]:
    """Options that plug-ins add to a command; without those that do not load."""
    found: list[AddedOptions] = []
    with suppress(UserError):
        for part in parts_of("asia.command_options"):
            if part.name.partition(".")[0] == name and part.why_not() is None:
                found.append(cast("AddedOptions", part.load()))
    return found


@app.callback(invoke_without_command=True)
def _version(
    version: bool = typer.Option(False, "--version", help="Print the version and exit."),
) -> None:
    if version:
        from asia import __version__

        say(f"asia {__version__}")
        raise typer.Exit
    if sys.platform == "win32":
        raise UserError(doctor.WINDOWS)


def main() -> None:
    """Entry point of the `asia` command."""

    def terminate(number: int, frame: FrameType | None) -> NoReturn:
        """Exit as for an interrupt, so that workers are stopped and the ledger is closed."""
        sys.exit(TERMINATED)

    def complain(message: str, code: int) -> int:
        say(f"asia: {message}", file=sys.stderr)
        return code

    before = signal.signal(signal.SIGTERM, terminate)
    try:
        app(args=spread(sys.argv[1:]))
    except UserError as error:
        sys.exit(complain(str(error), 2))
    except CandidateError as error:
        sys.exit(complain(f"the candidate failed: {error.reason.advice}", 1))
    except SandboxError as error:
        sys.exit(complain(f"the sandbox failed: {error}", 1))
    except OSError as error:
        sys.exit(complain(f"{error.strerror or error}: {error.filename or 'a file'}", 2))
    except Exception as error:
        # A search has written its traceback already.
        notes = getattr(error, "__notes__", ())
        if not notes:
            raise
        sys.exit(complain(f"internal error: {error_sentence(error)}; {'; '.join(notes)}", 1))
    except SystemExit as end:
        if end.code in (INTERRUPTED, TERMINATED):
            words = sys.argv[1:]
            resumed = words[:1] in (["run"], ["extend"], ["bench"]) or words[:2] in (
                ["agent", "workspace"],
                ["agent", "mcp"],
            )
            resumed |= words[:1] == ["validate"] and not {"--repeat", "--ablate"}.isdisjoint(words)
            how = "interrupted" if end.code == INTERRUPTED else "terminated"
            more = "; the same command continues from here" if resumed else ""
            complain(f"{how}{more}", end.code)
        raise
    finally:
        signal.signal(signal.SIGTERM, before)


_ASSIGNED = re.compile(r"[^-=/]+=[^=]")


def spread(words: list[str]) -> list[str]:
    """Repeat a list option before each of its words: `--train a.csv b.csv` becomes `--train a.csv
    --train b.csv`. Raises UserError for a second NAME=VALUE after an option that takes one word."""
    known = {
        "init": init.LISTS,
        "validate": ("--columns",),
        "bench agents": _bench.LISTS,
    }
    lists = known.get(" ".join(words[:1])) or known.get(" ".join(words[:2])) or ()
    for name, first, second in zip(words, words[1:], words[2:], strict=False):
        alone = name.startswith("--") and name not in lists
        if alone and all(map(_ASSIGNED.match, (first, second))):
            raise UserError(
                f"'{second}' belongs to no option: {name} takes one word, so write "
                f"{name} {first},{second}"
            )
    if not lists:
        return words
    option: str | None = None
    found: list[str] = []
    for word in words:
        if word.startswith("-"):
            name, equals, _ = word.partition("=")
            option = name if name in lists else None
            found += [word] if equals or option is None else []
        else:
            found += [word] if option is None else [option, word]
    return found
