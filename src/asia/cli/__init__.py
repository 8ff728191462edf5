"""The command line: parse, call the library, exit code. One file a command.

Exit codes: 0 done; 1 a bug, a broken sandbox or a replay that differs; 2 something the user can
mend; 3 a search whose candidates all failed; 130 interrupted (SIGINT), 143 terminated (SIGTERM).
"""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable
from types import FrameType
from typing import NoReturn

import typer

from asia._boundary import error_sentence
from asia._text import say
from asia.cli import (
    _ablate,
    _bench,
    _check,
    _compare,
    _confirm,
    _demo,
    _diff,
    _doctor,
    _export,
    _init,
    _llm_check,
    _mcp,
    _models,
    _redteam,
    _replay,
    _report,
    _run,
    _show,
    _status,
    _steer,
    _try,
    _unseal,
    _validate,
    _verify,
    _view,
    _workspace,
)
from asia.cli._options.groups import with_groups
from asia.errors import CandidateError, SandboxError, UserError

__all__ = ["app", "main"]

RESUMED = frozenset({"run", "bench", "compare", "confirm", "ablate", "workspace", "mcp"})
INTERRUPTED = 130
TERMINATED = 128 + signal.SIGTERM

app = typer.Typer(
    name="asia",
    help=(
        "Identify a dynamical system from its records: search for models, score them by "
        "open-loop simulation, return a model with the evidence for it."
    ),
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
)
# What a newcomer needs, then what comes with its capability.
_FIRST: dict[str, Callable[..., None]] = {
    "init": _init.init,
    "check": _check.check,
    "run": _run.run,
    "status": _status.status,
    "show": _show.show,
    "unseal": _unseal.unseal,
    "report": _report.report,
}
_MORE: dict[str, Callable[..., None]] = {
    "diff": _diff.diff,
    "confirm": _confirm.confirm,
    "ablate": _ablate.ablate,
    "validate": _validate.validate,
    "export": _export.export,
    "view": _view.view,
    "verify": _verify.verify,
    "replay": _replay.replay,
    "bench": _bench.bench,
    "compare": _compare.compare,
    "llm-check": _llm_check.llm_check,
    "models": _models.models,
    "demo": _demo.demo,
    "workspace": _workspace.workspace,
    "try": _try.try_,
    "steer": _steer.steer,
    "pause": _steer.pause,
    "stop": _steer.stop,
    "mcp": _mcp.mcp,
    "mcp-config": _mcp.mcp_config,
    "doctor": _doctor.doctor,
    "redteam": _redteam.redteam,
}
for _panel, _commands in ((None, _FIRST), ("More commands", _MORE)):
    for _name, _command in _commands.items():
        app.command(_name, rich_help_panel=_panel)(with_groups(_command))


@app.callback(invoke_without_command=True)
def _version(
    version: bool = typer.Option(False, "--version", help="Print the version and exit."),
) -> None:
    if version:
        from asia import __version__

        say(f"asia {__version__}")
        raise typer.Exit
    if sys.platform == "win32":
        raise UserError(_doctor.WINDOWS)


def main() -> None:
    """Entry point of the `asia` command."""
    before = signal.signal(signal.SIGTERM, _terminate)
    try:
        app(args=spread(sys.argv[1:]))
    except UserError as error:
        sys.exit(_complain(str(error), 2))
    except CandidateError as error:
        sys.exit(_complain(f"the candidate failed: {error.reason.advice}", 1))
    except SandboxError as error:
        sys.exit(_complain(f"the sandbox failed: {error}", 1))
    except OSError as error:
        sys.exit(_complain(f"{error.strerror or error}: {error.filename or 'a file'}", 2))
    except Exception as error:
        # A search has written its traceback already.
        notes = getattr(error, "__notes__", ())
        if not notes:
            raise
        sys.exit(_complain(f"internal error: {error_sentence(error)}; {'; '.join(notes)}", 1))
    except SystemExit as end:
        if end.code == INTERRUPTED:
            _complain(_ended("interrupted"), INTERRUPTED)
        if end.code == TERMINATED:
            _complain(_ended("terminated"), TERMINATED)
        raise
    finally:
        signal.signal(signal.SIGTERM, before)


def _terminate(number: int, frame: FrameType | None) -> NoReturn:
    """As an interrupt: what runs ends its workers on the way out, and the ledger stays whole."""
    sys.exit(TERMINATED)


def _ended(how: str) -> str:
    resumed = RESUMED.intersection(sys.argv[1:2])
    return f"{how}; the same command continues from here" if resumed else how


def spread(words: list[str]) -> list[str]:
    """`--train a.csv b.csv` and `--train=a.csv b.csv` with the option before each word, for the
    list options of these commands."""
    known = {
        "init": _init.LISTS,
        "validate": ("--columns",),
        "bench": _bench.LISTS,
        "compare": _compare.LISTS,
        "redteam": _redteam.LISTS,
    }
    lists = known.get(words[0] if words else "")
    if lists is None:
        return words
    option: str | None = None
    answer: list[str] = []
    for word in words:
        if word.startswith("-"):
            name, equals, _ = word.partition("=")
            option = name if name in lists else None
            answer += [word] if equals or option is None else []
        elif option is not None:
            answer += [option, word]
        else:
            answer.append(word)
    return answer


def _complain(message: str, code: int) -> int:
    say(f"asia: {message}", file=sys.stderr)
    return code
