"""asia unseal: open the test, once."""

from __future__ import annotations

import json as jsonlib
import sys
from collections.abc import Iterator
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any

import typer

from asia._text import one_line, say
from asia.interfaces.cli.options import (
    DEFAULT_RUNS,
    Json,
    Keys,
    RunName,
    Runs,
    YesProcess,
    run_directory,
)
from asia.interfaces.cli.text import board_lines, board_object

if TYPE_CHECKING:
    from pathlib import Path

    from asia.judge.scoring.outcome import Failure, MeeTable
    from asia.ledger.events import TestBands, TestedModel, Unsealed
    from asia.ledger.run import Run
    from asia.ledger.view import SearchView


def unseal(
    run: RunName = None,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask; for scripts.")] = False,
    yes_process: YesProcess = False,
    keys: Keys = None,
    runs: Runs = DEFAULT_RUNS,
    json: Json = False,
) -> None:
    """Score the winner on the sealed test. This ends the search and can be done once."""
    from asia.interfaces.workspace.server import end_idle
    from asia.ledger.run import open_run
    from asia.problem.load import load_lock
    from asia.report import write_report
    from asia.report.published import read_board
    from asia.search.unsealing import needs_consent
    from asia.search.unsealing import unseal as open_seal

    directory = run_directory(runs, run, named=True)
    opened = open_run(directory)
    if opened.view.unsealed is None and not yes:
        _ask(opened)
    consent = yes_process or _consents(opened)
    if consent or not needs_consent(opened.view):
        end_idle(directory, lambda line: say(line, file=sys.stderr))
    result = open_seal(directory, process_consent=consent, keys=keys)
    if result.opened_before:
        names = ", ".join(result.opened_before)
        say(f"note: this test was opened before, by {names}", file=sys.stderr)
    if not result.first_time:
        say("already unsealed: this is the first and only result", file=sys.stderr)
    view = open_run(directory).view
    board = read_board(load_lock(directory / "problem.lock.toml"), view)
    # What was drawn before is not changed by the test.
    draw = partial(write_report, directory, missing_only=result.first_time)
    if json:
        draw()
        answer = {**_as_object(result.record), "use": _use(result.record, view), **_settings(view)}
        answer |= board_object(board)
        say(jsonlib.dumps(answer, allow_nan=False))
        _renew_page(directory)
        return
    _print_text(result.record, view, by_record=not board.unit_is_outputs)
    for line in _setting_lines(view):
        say(line)
    for picture in draw():
        if picture.suffix == ".png" and picture.stem in ("test", "leaderboard"):
            say(f"picture  {picture}")
    for line in board_lines(board):
        say(line)
    _renew_page(directory)


def _renew_page(directory: Path) -> None:
    """Write the page again, because the old one says that the test is sealed. A failure is only
    reported."""
    from asia.errors import InternalError
    from asia.report import write_page

    try:
        write_page(directory)
    except InternalError as error:
        say(f"the page was not updated: {error}", file=sys.stderr)


def _ask(opened: Run) -> None:
    """Raise UserError unless the user types the name of the run."""
    from asia.errors import UserError

    if not sys.stdin.isatty():
        raise UserError("unseal asks for the run's name; in a script give --yes")
    say(
        f"This opens the sealed test of run {opened.name} and ends its search, irreversibly.",
        file=sys.stderr,
    )
    if typer.prompt("Type the run's name to continue", err=True) != opened.name:
        raise UserError("the name does not match; nothing was opened")


def _settings(view: SearchView) -> dict[str, str]:
    """Return the settings that must be equal to compare V of winners."""
    start = view.started
    return {"early_stopping": start.early_stopping, "residuals": start.residuals}


def _setting_lines(view: SearchView) -> Iterator[str]:
    from asia.interfaces.cli.text import validation_words

    if view.started.early_stopping == "validation":
        yield f"chosen {validation_words(view.validation_scores)}; the test itself was never seen"
    if view.started.residuals == "held_out":
        yield "chosen with held-out residuals shown; the test itself was never seen"


def _consents(opened: Run) -> bool:
    """Ask whether to open a test that candidates could read; False without a terminal."""
    from asia.errors import UserError
    from asia.search.unsealing import CONSENT, needs_consent

    view = opened.view
    if view.unsealed is not None or not needs_consent(view) or not sys.stdin.isatty():
        return False
    say(f"Note: {CONSENT.format(run=opened.name)}.", file=sys.stderr)
    if not typer.confirm("Open the test anyway?", default=False, err=True):
        raise UserError("nothing was opened; search again at a stronger level, see asia doctor")
    return True


def _as_object(record: Unsealed) -> dict[str, Any]:
    answer: dict[str, Any] = {
        "test": _scores(record, record.ensemble),
        "experiment": record.experiment,
        "skip": record.skip,
    }
    for name, model in (("refit", record.refit), ("stack", record.stack)):
        if model is not None:
            answer[name] = _scores(record, model)
    if record.bands is not None:
        answer["bands"] = {
            "model": record.bands.model,
            "level": record.bands.level,
            "covered": dict(zip(record.channels, record.bands.covered, strict=True)),
            "outside": record.bands.outside,
        }
    return answer


def _use(record: Unsealed, view: SearchView) -> dict[str, Any]:
    """Return the model to use with its scores."""
    from asia.ledger.run import model_to_use, tested_model

    named = model_to_use(view)
    assert named is not None
    return {
        "model": named.model,
        "reason": named.reason,
        **_scores(record, tested_model(record, named.model)),
    }


def _scores(record: Unsealed, model: TestedModel | Failure) -> dict[str, Any]:
    """Return the value of every metric and details of the first, or the failure."""
    from asia.judge.scoring.outcome import Failure

    if isinstance(model, Failure):
        return {"failure": model.reason.value, "advice": model.advice}
    first = model.scores[0]
    return {
        **{score.metric: score.value for score in model.scores},
        **({"mee": model.mee.by_group()} if model.mee is not None else {}),
        "per_channel": dict(zip(record.channels, first.per_channel, strict=True)),
        "per_trajectory": dict(zip(record.trajectories, first.per_trajectory, strict=True)),
    }


def _table_lines(mee: MeeTable) -> list[str]:
    """Return the table: a row per group, a column per step."""
    rows = mee.by_group()
    width = max(len("group"), *(len(name) for name in rows))
    columns = next(iter(rows.values()))
    lines = [f"{'group':<{width}}" + "".join(f"{name:>10}" for name in columns)]
    for name, row in rows.items():
        lines.append(f"{name:<{width}}" + "".join(f"{value:>10.4g}" for value in row.values()))
    return ["mean Euclidean error", *lines]


def _print_text(record: Unsealed, view: SearchView, *, by_record: bool) -> None:
    from asia.interfaces.cli.text import use_lines
    from asia.judge.scoring.outcome import Failure
    from asia.problem.metrics import metric_label

    how = f"{record.skip} samples skipped"
    if record.horizon is not None:
        how = f"windows of {record.horizon} samples"
    say(f"sealed test, experiment #{record.experiment:02d}, {how}")
    models: list[tuple[str, TestedModel | Failure]] = [
        ("ensemble of the fold models", record.ensemble)
    ]
    if record.refit is not None:
        models.append(("refit on all training data", record.refit))
    if record.stack is not None:
        models.append(("stack of several experiments", record.stack))
    for title, model in models:
        if isinstance(model, Failure):
            say(f"{title:<28} no score: {model.advice}")
            continue
        for score in model.scores:
            channels = ", ".join(
                f"{name} {value:.4g}"
                for name, value in zip(record.channels, score.per_channel, strict=True)
            )
            several = len(score.per_trajectory) > 1
            # An official figure is that of one record; a number over all of them is none.
            error = "by record" if several and by_record else f"{score.value:.4g}"
            channels = "" if several and by_record else f"  ({channels})"
            say(f"{title:<28} {metric_label(score.metric)} {error}{channels}")
            if several:
                for name, value in zip(record.trajectories, score.per_trajectory, strict=True):
                    say(f"    {name:<24} {value:.4g}")
        for line in _table_lines(model.mee) if model.mee is not None else ():
            say(f"    {line}")
    for line in use_lines(view)[:1]:
        say(f"model to {one_line(line)}")
    if record.bands is not None:
        say(_band_line(record.channels, record.bands))


def _band_line(channels: tuple[str, ...], bands: TestBands) -> str:
    """Return the measured and the nominal coverage of the output bands."""
    held = ", ".join(
        f"{name} {share:.1%}" for name, share in zip(channels, bands.covered, strict=True)
    )
    line = f"bands of {bands.level:.0%} around it held: {held}"
    if bands.outside > 0.0:
        line += f"; {bands.outside:.1%} of the samples are outside the region of validity"
    return line.replace("%", " %")
