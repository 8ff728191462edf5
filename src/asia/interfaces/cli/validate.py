"""asia validate: check a model for use; repeat or take apart its fits."""

from __future__ import annotations

import json as jsonlib
import sys
from collections.abc import Iterator
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from asia._text import say
from asia._timer import duration
from asia.errors import UserError
from asia.interfaces.cli.init import split_at_commas
from asia.interfaces.cli.options import ColumnNames, Experiment, RunName, RunOptions, Time, TimeUnit
from asia.interfaces.cli.output import verdict_lines, verdict_object
from asia.judge.scoring.repeated_fits import Interval
from asia.ledger.events import (
    Ablated,
    Confirmed,
    ConfirmedCandidate,
    ConfirmedPair,
    Fit,
)
from asia.ledger.run import open_run
from asia.presentation.table import error_value

if TYPE_CHECKING:
    from asia.judge.sandbox.types import Isolation

DEFAULT_TOP = 3
REPEAT_SEEDS = 5
ABLATE_SEEDS = 3
_fits = partial(typer.Option, rich_help_panel="Repeated fits (--repeat, --ablate)")


def validate(
    *,
    run: RunName = None,
    record: Annotated[
        Path | None,
        typer.Option(
            help="File with the problem's columns to validate the model on, in any format that "
            "asia init reads."
        ),
    ] = None,
    time: Time = None,
    time_unit: TimeUnit = None,
    columns: ColumnNames = None,
    experiment_column: Experiment = None,
    repeat: Annotated[
        bool,
        _fits(
            "--repeat",
            help="Fit the best candidates again from other seeds on every fold: which differ "
            "significantly, and the error to expect of the best candidate.",
        ),
    ] = False,
    ablate: Annotated[
        bool,
        _fits(
            "--ablate",
            help="Fit the best candidate with parts taken back: its model with the baseline's "
            "training, its training with the baseline's model, and without each change of its "
            "lineage.",
        ),
    ] = False,
    top: Annotated[
        int | None,
        _fits(min=1, help=f"Candidates to repeat, lowest V first; default {DEFAULT_TOP}."),
    ] = None,
    seeds: Annotated[
        int | None,
        _fits(
            min=1,
            help=f"Seeds for each; default {REPEAT_SEEDS} with --repeat, {ABLATE_SEEDS} with "
            "--ablate. One if fits do not depend on the seed.",
        ),
    ] = None,
    options: RunOptions,
) -> None:
    """Check whether the model of a run is valid: fit for use, with a list of its deficiencies; on a
    record of your own with --record.

    Uses the held-out folds, small steps and a long simulation. The sealed test stays closed.
    --repeat and --ablate fit the candidates of a finished search again, on training records only.
    After an interrupt, the same command continues.
    """
    from asia.analysis.validation import validate as check
    from asia.data.intake.sheet import Wanted
    from asia.report.files import write_validation

    reading = Wanted(
        (), (), time, time_unit, experiment_column, tuple(split_at_commas(columns or ()))
    )
    if repeat and ablate:
        raise UserError("--repeat and --ablate do not go together: give one of them")
    if top is not None and not repeat:
        raise UserError("--top belongs to --repeat: add --repeat or leave it out")
    if seeds is not None and not (repeat or ablate):
        raise UserError("--seeds belongs to --repeat or --ablate: add one of them or leave it out")
    if (repeat or ablate) and (record is not None or reading != Wanted((), ())):
        option = "--repeat" if repeat else "--ablate"
        raise UserError(f"{option} uses training records only: leave --record and its columns out")
    directory, level, json = options.directory(run), options.level, options.json
    if repeat:
        _repeat(directory, top or DEFAULT_TOP, seeds or REPEAT_SEEDS, level, json=json)
        return
    if ablate:
        _ablate(directory, seeds or ABLATE_SEEDS, level, json=json)
        return
    found = check(
        directory,
        record,
        lambda text: say(f"checking {text}", file=sys.stderr),
        None if reading == Wanted((), ()) else reading,
        level,
    )
    failed: list[str] = []
    for path in write_validation(directory, found.checks, found.summary, failed):
        say(str(path), file=sys.stderr)
    for line in failed:
        say(f"note    {line}", file=sys.stderr)
    if json:
        for one in found.checks:
            line = {"check": one.name, "verdict": one.verdict, "sentence": one.sentence}
            say(jsonlib.dumps({**line, "cause": one.cause}, allow_nan=False))
        end = {name: getattr(found, name) for name in ("run", "experiment", "model", "record")}
        end |= {"recorded": found.recorded, "summary": found.summary}
        end["verdict"] = verdict_object(open_run(directory).view)
        say(jsonlib.dumps(end, allow_nan=False))
        return
    for one in found.checks:
        say(f"{one.verdict.upper():6}{one.name}: {one.sentence}")
    records = found.record or "the held-out parts of the training records"
    if not found.recorded:
        say("the search is not finished: its ledger does not keep this report", file=sys.stderr)
    what = f"{found.model} of experiment {found.experiment}, on {records}"
    if found.record is None:
        what = (
            f"fold models of experiment {found.experiment} on {records}, small steps and long runs "
            f"of the {found.model}"
        )
    say(f"checked: {what}; the sealed test was not used")
    say(found.summary)
    for line in verdict_lines(open_run(directory).view):
        say(line)


# Repeated fits of the best candidates (--repeat).


def _repeat(directory: Path, top: int, seeds: int, level: Isolation, *, json: bool) -> None:
    from asia.analysis.confirmation import confirm

    def fitted(event: Fit, done: int, total: int) -> None:
        if json:
            fit = {"event": "repeated", "experiment": event.experiment, "repeat": event.seed}
            line = {**fit, "V": event.value, "same": event.same, "done": done, "of": total}
            say(jsonlib.dumps(line, allow_nan=False), flush=True)
            return
        value = event.failed if event.value is None else error_value(event.value)
        same = ", as in the search: its fits do not depend on the seed" if event.same else ""
        say(
            f"#{event.experiment:02d} seed {event.seed}: V={value} in "
            f"{duration(event.seconds)}{same}  [{done} of {total}]",
            file=sys.stderr,
            flush=True,
        )

    found, new = confirm(directory, fitted, top=top, seeds=seeds, isolation=level)
    if json:
        say(jsonlib.dumps({"new": new, **asdict(found)}, allow_nan=False))
        return
    if not new:
        say("nothing new to fit: these results are in the ledger", file=sys.stderr)
    for line in confirmation_lines(found, open_run(directory).view.v_name):
        say(line)


def confirmation_lines(
    found: Confirmed, v_name: str = "V", experiment: int | None = None
) -> Iterator[str]:
    """Yield a line per candidate and per pair, variance over seeds, expected error, verdict.

    experiment: yield only the lines about it; none if it was not repeated.
    """
    for candidate in found.candidates:
        if experiment in (None, candidate.experiment):
            yield _candidate_line(candidate, v_name)
    for number in found.failed if experiment is None else ():
        yield f"#{number:02d} failed with every seed: not ranked"
    for pair in found.pairs:
        if experiment in (None, pair.first, pair.second):
            yield _pair_line(pair)
    if experiment is None:
        if found.pairs:
            yield (
                f"all intervals hold together at {found.level:.0%}".replace("%", " %")
                + f"; they are corrected for the {found.tried} candidates of the search"
            )
        yield f"variance over seeds: {noise_words(found)}"
    if found.expected is not None and experiment in (None, found.best):
        level = f"{found.expected_level:.0%}".replace("%", " %")
        yield (
            f"expected error of #{found.best:02d} on a new record, scaled as {v_name}: "
            f"{error_value(found.expected.value)}, {level} between "
            f"{error_value(found.expected.low)} and {error_value(found.expected.high)}"
        )
        if found.ensemble is not None:
            yield (
                f"    of the ensemble: {error_value(found.ensemble.value)}, between "
                f"{error_value(found.ensemble.low)} and {error_value(found.ensemble.high)}"
            )
        yield (
            f"    includes {found.expected.optimism:.2g} for the selection from "
            f"{found.tried} candidates"
        )
        yield (
            "    is the error of one fold model of the search; the new record is of the same kind "
            "and as long as a fold"
        )
    if experiment is None:
        yield verdict(found)
        if found.after_unsealing:
            yield "computed after the sealed test was opened; it was not used"


def verdict(found: Confirmed) -> str:
    """Return the verdict on the best candidate in one sentence."""
    best = f"#{found.best:02d}"
    if not found.candidates or found.best in found.failed:
        return f"{best} is not confirmed: it failed with every other seed"
    if all(one.experiment != found.best for one in found.candidates):
        return f"{best} is not confirmed: it was not repeated"
    equal = [
        pair.first if pair.second == found.best else pair.second
        for pair in found.pairs
        if not pair.apart and found.best in (pair.first, pair.second)
    ]
    if not equal and found.candidates[0].experiment == found.best:
        if len(found.candidates) == 1:
            return f"{best} was the only candidate repeated: there is no comparison"
        return f"{best} is confirmed: it is better than all other repeated candidates"
    better = [p.first for p in found.pairs if p.second == found.best and p.apart]
    if better:
        names = " and ".join(f"#{number:02d}" for number in better)
        return f"{best} is not confirmed: {names} {'is' if len(better) == 1 else 'are'} better"
    names = " and ".join(f"#{number:02d}" for number in equal)
    return f"{best} and {names} are statistically equal: prefer the simplest of them"


def noise_words(found: Confirmed) -> str:
    """Return the standard deviation of V over seeds."""
    if found.noise is None:
        return "not known: needs two seeds with a score"
    if found.noise == 0.0:
        return "0, because the fits do not depend on the seed"
    return f"standard deviation of V {found.noise:.2g}"


def _pair_line(pair: ConfirmedPair) -> str:
    """`#12 and #09 are statistically equal: they differ by 0.0012 (-0.0031 to 0.0055)`."""
    first, second, gap = f"#{pair.first:02d}", f"#{pair.second:02d}", pair.difference
    figures = f"{gap.value:.4g} ({gap.low:.3g} to {gap.high:.3g})"
    if pair.apart:
        return f"{first} is better than {second} by {figures}"
    return f"{first} and {second} are statistically equal: they differ by {figures}"


def _candidate_line(candidate: ConfirmedCandidate, v_name: str) -> str:
    """`rank 1 to 2  #12  V=0.1034 (0.0981 to 0.1087)  in the search 0.1002  5 seeds ...`."""
    low, high = candidate.best_rank, candidate.worst_rank
    rank = f"rank {low}" if low == high else f"rank {low} to {high}"
    seeds = f"{candidate.repeats} seeds"
    if candidate.deterministic:
        seeds = "does not depend on the seed: one repeat gave the same V"
    elif candidate.spread is not None:
        seeds += f", s.d. {candidate.spread:.2g}"
    if candidate.failed:
        seeds += f", {candidate.failed} failed"
    mean = candidate.value
    return (
        f"{rank:<12} #{candidate.experiment:02d}  {v_name}={error_value(mean.value)} "
        f"({error_value(mean.low)} to {error_value(mean.high)})  in the "
        f"search {error_value(candidate.first)}  {seeds}"
    )


# The gain of the best candidate in parts (--ablate).


def _ablate(directory: Path, seeds: int, level: Isolation, *, json: bool) -> None:
    from asia.analysis.ablation import ablate
    from asia.report.files import write_report

    def fitted(event: Fit, done: int, total: int) -> None:
        if json:
            fit = {"event": "ablation_fit", "variant": event.variant, "seed": event.seed}
            line = {**fit, "V": event.value, "failed": event.failed, "done": done, "of": total}
            say(jsonlib.dumps(line, allow_nan=False), flush=True)
            return
        value = event.failed if event.value is None else f"V={error_value(event.value)}"
        text = f"{event.variant}, seed {event.seed}: {value} in {duration(event.seconds)}"
        say(f"{text}  [{done} of {total}]", file=sys.stderr, flush=True)

    found, new = ablate(directory, fitted, seeds=seeds, isolation=level)
    if json:
        say(jsonlib.dumps({"new": new, **asdict(found)}, allow_nan=False))
        return
    if not new:
        say("nothing new to fit: these results are in the ledger", file=sys.stderr)
    for line in _ablation_lines(found, open_run(directory).view.v_name):
        say(line)
    for picture in write_report(directory):
        if picture.name == "ablation.png":
            say(f"picture  {picture}")


def _ablation_lines(found: Ablated, v_name: str) -> Iterator[str]:
    """Yield the causes of the gain, and a line for each change that was left out."""
    crossing = found.crossing
    if crossing is None:
        yield f"model and training cannot be crossed: {found.detail}"
    else:
        yield (
            f"{v_name} of the best candidate #{found.best:02d} is lower than that of the "
            f"baseline by {_interval(crossing.gain)}"
        )
        for name, part in (
            ("its model", crossing.model),
            ("its training", crossing.training),
            ("both together", crossing.interaction),
        ):
            share = crossing.share(part)
            percent = "" if share is None else f"{100 * share:5.0f} %  "
            yield f"  {name:<14} {percent}{_interval(part)}"
    for one in found.left_out:
        name = f"without the change of #{one.experiment:02d}"
        if one.loss is None:
            yield f"{name}: not known; {one.detail}"
        else:
            yield f"{name}: {v_name} is higher by {_interval(one.loss)}"


def _interval(interval: Interval) -> str:
    ends = f"{error_value(interval.low)} to {error_value(interval.high)}"
    exact = interval.low == interval.high
    return error_value(interval.value) + ("" if exact else f" ({ends})")
