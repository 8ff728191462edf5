"""asia unseal: open the test, once."""

from __future__ import annotations

import json as jsonlib
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from asia._text import say
from asia.analysis.verdict import alarms
from asia.errors import InternalError, UserError
from asia.interfaces.cli.options import Keys, RunName, RunOptions, YesProcess
from asia.interfaces.cli.output import fact_line, print_alarms, verdict_facts
from asia.judge.scoring.outcome import Failure
from asia.ledger.events import TestedModel, Unsealed
from asia.ledger.run import Run, model_to_use, open_run, tested_model
from asia.ledger.view import SearchView
from asia.presentation.integrity import later_text, v_notes
from asia.presentation.results import sealed_test_blocks
from asia.presentation.table import block_lines

if TYPE_CHECKING:
    from asia.judge.sandbox.types import Isolation
    from asia.report.published import Board


def unseal(
    *,
    run: RunName = None,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask; for scripts.")] = False,
    yes_process: YesProcess = False,
    keys: Keys = None,
    options: RunOptions,
) -> None:
    """Score the best candidate on the sealed test. This ends the search and can be done once."""
    from asia.interfaces.workspace.server import end_idle
    from asia.problem.load import load_lock
    from asia.report.published import read_board
    from asia.search.unsealing import needs_consent
    from asia.search.unsealing import unseal as open_seal

    directory = options.directory(run, named=True)
    opened = open_run(directory)
    if opened.view.unsealed is None and not yes:
        if not sys.stdin.isatty():
            raise UserError("unseal asks for the run's name; in a script give --yes")
        say(
            f"This opens the sealed test of run {opened.name} and ends its search, irreversibly.",
            file=sys.stderr,
        )
        if typer.prompt("Type the run's name to continue", err=True) != opened.name:
            raise UserError("the name does not match; nothing was opened")
    level = options.level if opened.view.unsealed is None else None
    consent = yes_process or _consents(opened, level)
    if consent or not needs_consent(opened.view, level):
        end_idle(directory, options.level, lambda line: say(line, file=sys.stderr))
    result = open_seal(directory, process_consent=consent, keys=keys, isolation=level)
    if words := later_text(result.opened_before):
        say(words, file=sys.stderr)
    if not result.first_time:
        say("the test of this run is open already: this is its only result", file=sys.stderr)
    view = open_run(directory).view
    board = read_board(load_lock(directory / "problem.lock.toml"), view)

    def draw() -> tuple[Path, ...]:
        """Draw the pictures of the test; what was drawn before is not changed by it."""
        from asia.report.files import write_report  # takes a second, the scores come before

        return write_report(directory, missing_only=result.first_time)

    if options.json:
        draw()
        say(jsonlib.dumps(_result_object(result.record, view, board), allow_nan=False))
    else:
        _print_result(result.record, view, by_record=not board.unit_is_outputs)
        for picture in draw():
            if picture.suffix == ".png" and picture.stem in ("test", "leaderboard"):
                say(f"picture  {picture}")
        if _is_benchmark(board):
            width = max((len(s.figure.name) for s in board.standings), default=0)
            for standing in board.standings:
                figure = standing.figure
                value = f"official {figure.name:<{width}} {figure.value:.4g} {board.unit}"
                say(f"{value}  {standing.words}".rstrip())
            if board.submission:
                say(f"submit   {board.submission}")
    # The old page says that the test is sealed.
    from asia.report.page.page import write_page

    try:
        write_page(directory)
    except InternalError as error:
        say(f"the page was not updated: {error}", file=sys.stderr)


def _consents(opened: Run, level: Isolation | None) -> bool:
    """Ask whether to open a test that candidates could read; False without a terminal."""
    from asia.search.unsealing import CONSENT, needs_consent

    view = opened.view
    if view.unsealed is not None or not needs_consent(view, level) or not sys.stdin.isatty():
        return False
    say(f"Note: {CONSENT.format(run=opened.name)}.", file=sys.stderr)
    if not typer.confirm("Open the test anyway?", default=False, err=True):
        raise UserError("nothing was opened; search again at a stronger level, see asia doctor")
    return True


def _is_benchmark(board: Board) -> bool:
    return bool(board.entries) or not board.unit_is_outputs


def _result_object(record: Unsealed, view: SearchView, board: Board) -> dict[str, Any]:
    """Return the result as JSON, with the settings that must be equal to compare V of best
    candidates."""

    def scores(model: TestedModel | Failure) -> dict[str, Any]:
        """The value of every metric and details of the first, or the failure."""
        if isinstance(model, Failure):
            return {"failure": model.reason.value, "advice": model.advice}
        first = model.scores[0]
        return {
            **{score.metric: score.value for score in model.scores},
            **({"mee": model.mee.by_group()} if model.mee is not None else {}),
            "per_channel": dict(zip(record.channels, first.per_channel, strict=True)),
            "per_trajectory": dict(zip(record.trajectories, first.per_trajectory, strict=True)),
        }

    answer: dict[str, Any] = {
        "test": scores(record.ensemble),
        "experiment": record.experiment,
        "skip": record.skip,
        "opened_before": list(view.unsealing.opened_before) if view.unsealing else [],
    }
    for name, model in (("refit", record.refit), ("stack", record.stack)):
        if model is not None:
            answer[name] = scores(model)
    if record.bands is not None:
        answer["bands"] = {
            "model": record.bands.model,
            "level": record.bands.level,
            "covered": dict(zip(record.channels, record.bands.covered, strict=True)),
            "outside": record.bands.outside,
        }
    named, start = model_to_use(view), view.started
    assert named is not None
    used = scores(tested_model(record, named.model))
    answer["use"] = {"model": named.model, "reason": named.reason, **used}
    answer["alarms"] = list(alarms(view))
    answer |= {"early_stopping": start.early_stopping, "residuals": start.residuals}
    if _is_benchmark(board):
        figures = {
            s.figure.name: {
                "value": s.figure.value,
                "rank": s.rank if s.among > 1 else None,
                "among": s.among,
                "above": None
                if s.above is None
                else {"value": s.above_value, "result": s.above.words},
            }
            for s in board.standings
        }
        answer["official"] = {
            "unit": board.unit,
            "figures": figures,
            "submission": board.submission,
        }
    return answer


def _print_result(record: Unsealed, view: SearchView, *, by_record: bool) -> None:
    print_alarms(view)
    named = model_to_use(view)
    blocks = sealed_test_blocks(record, named.model if named else None, total=not by_record)
    for line in block_lines(blocks):
        say(line)
    for label, text in verdict_facts(view):
        say(fact_line(label, text))
    for words in v_notes(view):
        say(f"V is {words}; the test itself was never seen")
