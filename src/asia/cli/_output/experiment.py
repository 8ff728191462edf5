"""Layout of one experiment on a terminal."""

from __future__ import annotations

from typing import Any

from rich.table import Table
from rich.text import Text

from asia._text import printable_line
from asia.cli._output.confirmation import lines_about
from asia.cli._output.terminal import Terminal
from asia.cli._output.words import again_words, use_lines
from asia.evaluation import FAR_BELOW, consistency
from asia.ledger import (
    Experiment,
    Proposed,
    Run,
    describe_result,
    error_value,
    evidence_lines,
    evidence_of,
    identified,
    identified_lines,
    identified_object,
    phase_words,
    settings_of_run,
)
from asia.protocol import metric_label
from asia.scoring import Score

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
    console.print(title, printable_line(f"({p.family}, {phase_words(p.phase)}{parent})"))
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
    if ratio >= FAR_BELOW:
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
