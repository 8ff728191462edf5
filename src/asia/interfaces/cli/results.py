"""Text of results: experiment, ablation, confirmation, comparison."""

from __future__ import annotations

import json as jsonlib
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from rich.table import Table
from rich.text import Text

from asia._text import printable_line, say
from asia.interfaces.cli.text import Terminal, again_words, use_lines
from asia.judge.evaluation.results import SUSPICIOUS_RATIO, consistency
from asia.judge.scoring.confirmation import Interval
from asia.judge.scoring.outcome import Score
from asia.ledger.events import (
    Ablated,
    Confirmed,
    ConfirmedCandidate,
    ConfirmedPair,
    LeftOut,
    Proposed,
)
from asia.ledger.evidence import evidence_of, identified, settings_of_run
from asia.ledger.run import Run
from asia.ledger.text import (
    describe_result,
    error_value,
    evidence_lines,
    identified_lines,
    identified_object,
    phase_text,
)
from asia.ledger.view import Experiment
from asia.problem.metrics import metric_label

if TYPE_CHECKING:
    from asia.assurance.bench.comparison import ComparisonPlan, PlannedRun
    from asia.ledger.events import Event
    from asia.ledger.view import SearchView


# Text of an ablation.


def ablation_lines(found: Ablated, v_name: str = "V") -> Iterator[str]:
    """Yield the causes of the gain, and a line for each change that was left out."""
    crossing = found.crossing
    if crossing is None:
        yield f"model and training cannot be crossed: {found.detail}"
    else:
        yield (
            f"{v_name} of the winner #{found.winner:02d} is lower than that of the baseline by "
            f"{_words(crossing.gain)}"
        )
        for name, part in (
            ("its model", crossing.model),
            ("its training", crossing.training),
            ("both together", crossing.interaction),
        ):
            share = crossing.share(part)
            told = "" if share is None else f"{100 * share:5.0f} %  "
            yield f"  {name:<14} {told}{_words(part)}"
    for one in found.left_out:
        yield _left_out_line(one, v_name)


def _left_out_line(one: LeftOut, v_name: str) -> str:
    name = f"without the change of #{one.experiment:02d}"
    if one.loss is None:
        return f"{name}: not known; {one.detail}"
    return f"{name}: {v_name} is higher by {_words(one.loss)}"


def _words(interval: Interval) -> str:
    ends = f"{error_value(interval.low)} to {error_value(interval.high)}"
    alone = interval.low == interval.high
    return error_value(interval.value) + ("" if alone else f" ({ends})")


# Progress lines of a comparison.


@dataclass
class Lines:
    """One line per experiment; with `json`, JSON lines on stdout and these lines on stderr."""

    json: bool
    start: float = field(default_factory=time.monotonic)

    def head(self, plan: ComparisonPlan) -> None:
        """Print the plan."""
        searches = plan.searches
        total = sum(run.problem.budget.experiments for run in searches)
        self.print(
            f"{plan.word} {plan.problem.name}: {len(searches)} searches, {total} experiments, "
            f"seeds {', '.join(str(s) for s in plan.seeds)}, early stopping "
            f"{', '.join(plan.settings)}"
        )

    def on_run(self, run: PlannedRun, number: int, total: int) -> None:
        """Print the name of the search."""
        self.print(f"\n[{number}/{total}] {run.name}")

    def on_event(self, event: Event, view: SearchView) -> None:
        """Print the line of an evaluated experiment."""
        from asia.interfaces.cli.text import experiment_line
        from asia.ledger.events import Evaluated

        if isinstance(event, Evaluated):
            self.print(experiment_line(view.experiment(event.experiment), view))

    def on_end(self, run: PlannedRun, view: SearchView) -> None:
        """Print the best V of the search."""
        from asia.ledger.text import error_value

        best = view.best
        value = best.score.value if best is not None and best.score is not None else None
        words = "no candidate has a score" if value is None else f"best V {error_value(value)}"
        self.print(f"    {words} after {len(view.finished)} experiments")
        if self.json:
            found = {
                "event": "run",
                "run": run.name,
                "arm": run.arm.name,
                "early_stopping": run.setting,
                "seed": run.seed,
                "experiments": len(view.finished),
                "V": value,
            }
            say(jsonlib.dumps(found, allow_nan=False), flush=True)

    def print(self, text: str) -> None:
        """Print a text line."""
        say(text, file=sys.stderr if self.json else sys.stdout, flush=True)


# Text of a confirmation (repeated fits).


def confirmation_lines(found: Confirmed, v_name: str = "V") -> Iterator[str]:
    """Yield a line per candidate and per pair, the noise floor, the expected error, the verdict."""
    for candidate in found.candidates:
        yield _candidate_line(candidate, v_name)
    for number in found.failed:
        yield f"#{number:02d} failed with every seed: not ranked"
    for pair in found.pairs:
        yield pair_words(pair)
    if found.pairs:
        yield (
            f"simultaneous level {found.level:.0%}".replace("%", " %")
            + f", corrected for the {found.tried} candidates of the search"
        )
    yield f"noise floor: {noise_words(found)}"
    yield from expected_lines(found, v_name)
    yield verdict(found)
    if found.after_unsealing:
        yield "computed after the sealed test was opened; it was not used"


def lines_about(found: Confirmed, experiment: int, v_name: str) -> Iterator[str]:
    """Yield the lines about one experiment; none if it was not repeated."""
    for candidate in found.candidates:
        if candidate.experiment == experiment:
            yield _candidate_line(candidate, v_name)
    for pair in found.pairs:
        if experiment in (pair.first, pair.second):
            yield pair_words(pair)
    if experiment == found.winner:
        yield from expected_lines(found, v_name)


def verdict(found: Confirmed) -> str:
    """Return the verdict on the winner in one sentence."""
    winner = f"#{found.winner:02d}"
    if not found.candidates or found.winner in found.failed:
        return f"{winner} is not confirmed: it failed with every other seed"
    if all(one.experiment != found.winner for one in found.candidates):
        return f"{winner} is not confirmed: it was not repeated"
    alike = _not_apart(found)
    if not alike and found.candidates[0].experiment == found.winner:
        if len(found.candidates) == 1:
            return f"{winner} was the only candidate repeated: there is no comparison"
        return f"{winner} is confirmed: it is better than all other repeated candidates"
    better = [p.first for p in found.pairs if p.second == found.winner and p.apart]
    if better:
        names = " and ".join(f"#{number:02d}" for number in better)
        return f"{winner} is not confirmed: {names} {'is' if len(better) == 1 else 'are'} better"
    names = " and ".join(f"#{number:02d}" for number in alike)
    return f"{winner} and {names} are statistically equal: prefer the simplest of them"


def pair_words(pair: ConfirmedPair) -> str:
    """`#12 and #09 are statistically equal: they differ by 0.0012 (-0.0031 to 0.0055)`."""
    names = f"#{pair.first:02d}", f"#{pair.second:02d}"
    gap = pair.difference
    figures = f"{gap.value:.4g} ({gap.low:.3g} to {gap.high:.3g})"
    if pair.apart:
        return f"{names[0]} is better than {names[1]} by {figures}"
    return f"{names[0]} and {names[1]} are statistically equal: they differ by {figures}"


def noise_words(found: Confirmed) -> str:
    """Return the noise floor."""
    if found.noise is None:
        return "not known: needs two seeds with a score"
    if found.noise == 0.0:
        return "0, the fits do not depend on the seed"
    return f"{found.noise:.2g}, standard deviation of V from seed to seed"


def expected_lines(found: Confirmed, v_name: str) -> Iterator[str]:
    """Yield the expected error of the winner, and its assumptions."""
    expected = found.expected
    if expected is None:
        return
    level = f"{found.expected_level:.0%}".replace("%", " %")
    yield (
        f"expected of #{found.winner:02d} on a new record, as {v_name}: "
        f"{error_value(expected.value)}, {level} between {error_value(expected.low)} and "
        f"{error_value(expected.high)}"
    )
    if found.ensemble is not None:
        yield (
            f"    of the ensemble: {error_value(found.ensemble.value)}, between "
            f"{error_value(found.ensemble.low)} and {error_value(found.ensemble.high)}"
        )
    yield (
        f"    of that {expected.optimism:.2g} for being the best of {found.tried}; it assumes a "
        "record of the same kind, as long as a fold, and is of a fold model as the search fitted it"
    )


def _candidate_line(candidate: ConfirmedCandidate, v_name: str) -> str:
    """`1 to 2  #12  V=0.1034 (0.0981 to 0.1087)  in the search 0.1002  5 seeds ...`."""
    low, high = candidate.best_rank, candidate.worst_rank
    rank = f"rank {low}" if low == high else f"rank {low} to {high}"
    seeds = f"{candidate.repeats} seeds"
    if candidate.deterministic:
        seeds = "does not depend on the seed: one repeat gave the same V"
    elif candidate.spread is not None:
        seeds += f", s.d. {candidate.spread:.2g}"
    if candidate.failed:
        seeds += f", {candidate.failed} failed"
    return (
        f"{rank:<12} #{candidate.experiment:02d}  {v_name}={_interval(candidate.value)}  in the "
        f"search {error_value(candidate.first)}  {seeds}"
    )


def _interval(value: Interval) -> str:
    return f"{error_value(value.value)} ({error_value(value.low)} to {error_value(value.high)})"


def _not_apart(found: Confirmed) -> list[int]:
    """Return the experiments that do not differ significantly from the winner."""
    open_pairs = [(p.first, p.second) for p in found.pairs if not p.apart]
    return [a if b == found.winner else b for a, b in open_pairs if found.winner in (a, b)]


# Layout of one experiment on a terminal.


# With more, each output gets a row of its own.
MOST_OUTPUTS_BESIDE = 3
_COLUMNS = """\
fit %: 100 (1 - |y - y_hat| / |y - mean of y|). Of the training records, worst output: train: error
as in V; bias: mean residual in s.d.; white, u-corr: largest correlation of the residual with its
own past and with past inputs; top, start: RMS residual in the highest tenth of the output and in
the first 5 % of a record, over that of all samples."""


def wide_console() -> Terminal:
    """Return a console with the terminal's width; wide in a pipe, so that no line is folded."""
    console = Terminal()
    return console if console.is_terminal else Terminal(width=200)


def describe(console: Terminal, run: Run, experiment: Experiment) -> None:
    """Print reasons, result, fold table and training-side evidence."""
    _print_reasons(console, run, experiment.proposed)
    r = experiment.result
    console.print(printable_line(f"result      {describe_result(experiment, run.view)}"))
    console.print(f"isolation   {run.view.started.isolation_words}")
    if r is None:
        return
    console.print(f"decision    {r.status}")
    refitted = run.view.refitted
    mine = refitted.failed_checks if refitted and refitted.experiment == experiment.number else ()
    for line in (*r.failed_checks, *mine):
        console.print(printable_line(f"note        {line}"))
    if refitted and refitted.again and refitted.experiment == experiment.number:
        same = f"fold {refitted.again.fold}, fitted a second time, gives the same result"
        console.print(f"again       {again_words(run.view) or same}")
    if run.view.confirmed is not None:
        for line in lines_about(run.view.confirmed, experiment.number, run.view.v_name):
            console.print(f"confirmed   {line}")
    if refitted and refitted.experiment == experiment.number:
        for line in use_lines(run.view):
            word, _, words = line.partition(" ")
            console.print(printable_line(f"{word:<12}{words.strip()}"))
    if experiment.score:
        _fold_table(console, run, experiment)
        console.print(f"\nV over the training error: {_ratio_words(experiment)}")
    if experiment.failure and experiment.failure.detail:
        console.print("\ndetail", style="bold")
        console.print(experiment.failure.detail)
    if not run.store.kept:
        return
    if refitted and refitted.experiment == experiment.number:
        _print_identified(console, run)
    evidence = evidence_of(
        experiment, run.view, run.store, settings_of_run(run.directory), bounded=False
    )
    if evidence.recorded:
        console.print("\nevidence", style="bold")
        for line in evidence_lines(evidence):
            console.print(line)
    elif r.output:
        tail = run.store.text(r.output).splitlines()[-20:]
        console.print("\nprinted while fitting (untrusted)", style="bold")
        for line in tail:
            console.print(line)


def _print_reasons(console: Terminal, run: Run, p: Proposed) -> None:
    """Print the proposal, its agent and its hypothesis."""
    parent = f", derived from #{p.parent:02d}" if p.parent else ""
    title = Text(printable_line(f"#{p.experiment:02d} {p.title}"), style="bold")
    console.print(title, printable_line(f"({p.family}, {phase_text(p.phase)}{parent})"))
    if p.leg:
        who = p.agent or "none: the baseline"
        legs = len(run.view.started.legs)
        console.print(printable_line(f"agent       {who}, in leg {p.leg} of {legs}"))
    console.print(printable_line(f"hypothesis  {p.hypothesis}"))
    console.print(printable_line(f"expected    {p.expected}"))
    if p.remark:
        console.print(printable_line(f"remark      {p.remark}"))


def experiment_object(run: Run, experiment: Experiment) -> dict[str, Any]:
    """Return the experiment as JSON."""
    proposed, result, score = experiment.proposed, experiment.result, experiment.score
    found = identified(run)
    mine = found is not None and found.experiment == experiment.number
    return {
        "run": run.name,
        "experiment": experiment.number,
        "title": proposed.title,
        "family": proposed.family,
        "phase": proposed.phase,
        "parent": proposed.parent,
        "hypothesis": proposed.hypothesis,
        "expected": proposed.expected,
        "remark": proposed.remark,
        "status": result.status if result else None,
        "V": score.value if score else None,
        "folds": [fold.value for fold in score.folds] if score else [],
        "reason": experiment.failure.reason.value if experiment.failure else None,
        **(identified_object(found) if found is not None and mine else {"parameters": None}),
    }


def _print_identified(console: Terminal, run: Run) -> None:
    found = identified(run)
    if found is None:
        return
    console.print("\nidentified model", style="bold")
    for line in identified_lines(found):
        console.print(printable_line(line))


def _fold_table(console: Terminal, run: Run, experiment: Experiment) -> None:
    score, result = experiment.score, experiment.result
    assert score is not None
    assert result is not None
    names, metric = run.view.started.outputs, run.metric
    wide = len(names) > MOST_OUTPUTS_BESIDE
    heads = metric_label(metric), "fit %"
    channels = () if wide else tuple(f"{head} {name}" for head in heads for name in names)
    table = Table(title="validation and training-side evidence", title_justify="left", box=None)
    table.add_column("fold", justify="right", overflow="fold")
    for head in ("V", *channels):
        table.add_column(head, justify="right", overflow="fold")
    asked = run.view.started.early_stopping == "validation"
    if asked:
        table.add_column("val. scores", justify="right", overflow="fold")
    for head in ("train", "bias", "white", "u-corr", "top", "start", "fit s"):
        table.add_column(head, justify="right", overflow="fold")
    for k, (fold, kept) in enumerate(zip(score.folds, result.folds, strict=True), 1):
        d, errors = kept.diagnostics, fold.per_channel(metric)
        table.add_row(
            str(k),
            error_value(fold.value),
            *(() if wide else (*map(_error, errors), *map(_fit, fold.fit_index))),
            *((str(kept.validation_scores),) if asked else ()),
            error_value(d.train_error),
            f"{d.bias:.3f}",
            f"{d.whiteness:.2f}",
            f"{d.input_correlation:.2f}",
            f"{d.top_error:.2f}",
            f"{d.start_error:.2f}",
            f"{kept.fit_seconds:.1f}",
        )
    console.print()
    console.print(table)
    console.print(_COLUMNS, style="dim")
    if wide:
        console.print()
        console.print(_channel_table(run, score))


def _ratio_words(experiment: Experiment) -> str:
    assert experiment.score is not None
    assert experiment.result is not None
    errors = [kept.diagnostics.train_error for kept in experiment.result.folds]
    ratio = consistency(experiment.score.value, errors)
    if ratio >= SUSPICIOUS_RATIO:
        return f"{ratio:.2f}"
    kept = "; V was the same when the folds were fitted again, one at a time"
    return f"{ratio:.2f}, suspiciously low{kept if experiment.result.status == 'keep' else ''}"


def _channel_table(run: Run, score: Score) -> Table:
    """Make a table with one row per output: metric and fit index on each fold."""
    metric = run.metric
    table = Table(title="by output", title_justify="left", box=None)
    table.add_column("output", overflow="fold")
    for head in (metric_label(metric), "fit %"):
        for k in range(1, len(score.folds) + 1):
            table.add_column(f"{head} {k}", justify="right", overflow="fold")
    for i, name in enumerate(run.view.started.outputs):
        errors = (_error(fold.per_channel(metric)[i]) for fold in score.folds)
        fits = (_fit(fold.fit_index[i]) for fold in score.folds)
        table.add_row(name, *errors, *fits)
    return table


def _error(value: float) -> str:
    return f"{value:.4g}"


def _fit(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f}"
