"""asia show: one experiment, or two side by side."""

import difflib
import json
from typing import Annotated

import typer
from rich.table import Table
from rich.text import Text

from asia._text import hand_over, printable, printable_line, say
from asia.errors import UserError
from asia.interfaces.cli.options import DEFAULT_RUNS, Json, Runs, run_directory
from asia.interfaces.cli.output import (
    Terminal,
    again_words,
    print_alarms,
    use_lines,
    verdict_lines,
    verdict_object,
)
from asia.interfaces.cli.validate import confirmation_lines
from asia.judge.evaluation.results import SUSPICIOUS_RATIO, consistency
from asia.ledger.evidence import (
    IdentifiedModel,
    evidence_of,
    identified,
    identified_by_folds,
    settings_of_run,
)
from asia.ledger.looks import seal_words
from asia.ledger.run import Run, open_run
from asia.ledger.view import Experiment
from asia.presentation.evidence import evidence_lines
from asia.presentation.experiments import confirmation_text, describe_result, phase_text
from asia.presentation.parameters import identified_lines, identified_object
from asia.presentation.table import error_value
from asia.problem.metrics import metric_label
from asia.recipe import MODELS, read_recipe

# Width of the columns that are not of an output.
_OTHER_COLUMNS = 64
# With more, each output gets a row of its own.
_MOST_OUTPUTS_AS_COLUMNS = 3
_COLUMNS = """\
V to fit %: on the held-out part. fit %: 100 (1 - |y - y_hat| / |y - mean of y|).
train to start: on the training records, for the worst output.
train: error, scaled as V. bias: mean residual, in standard deviations of the output.
white: largest correlation of the residual with its own past. u-corr: the same with past inputs.
top: RMS residual in the highest tenth of the output, divided by that of all samples.
start: the same for the first 5 % of a record. fit s: duration of the fit in seconds."""


def show(
    words: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[RUN] [N [M]]",
            help="Run (default: the newest) and experiment (default: the best, or the last if none "
            "has a score). Two numbers: both experiments, and the change of the source.",
        ),
    ] = None,
    source: Annotated[bool, typer.Option("--source", help="Print only candidate.py.")] = False,
    as_json: Json = False,
    runs: Runs = DEFAULT_RUNS,
) -> None:
    """Print an experiment: hypothesis, result, identified parameters, evidence, source. With two
    numbers, compare two experiments."""
    words = words or []
    name = words[0] if words and not words[0].isdecimal() else None
    numbers = words if name is None else words[1:]
    if not all(w.isdecimal() for w in numbers) or len(numbers) > 2:
        raise UserError(f"expected [RUN] [N [M]] with experiment numbers, got: {' '.join(words)}")
    run = open_run(run_directory(runs, name))
    view, store = run.view, run.store
    if not view.experiments:
        raise UserError(f"run '{run.name}' has no experiment yet")
    shown = [view.experiment(int(n)) for n in numbers] or [view.best or view.experiments[-1]]
    if source:
        if len(shown) > 1:
            raise UserError("--source prints one candidate.py: give one experiment number")
        hand_over(store.text(shown[0].source))
        return
    if as_json:
        for experiment in shown:
            hand_over(json.dumps(_experiment_object(run, experiment), allow_nan=False) + "\n")
        return
    console = wide_console()
    print_alarms(view)
    if said := seal_words(run.directory, view):
        say(said)
    if len(shown) > 1:
        for e in shown:
            say(f"#{e.number:02d} {e.proposed.title}: {describe_result(e, view)}")
        a, b = (store.text(e.source).splitlines() for e in shown)
        first, second = (f"#{e.number}" for e in shown)
        colours = {"+": "green", "-": "red", "@": "cyan"}
        for line in difflib.unified_diff(a, b, first, second, lineterm=""):
            console.print(Text(line, style=colours.get(line[:1], "")))
        return
    describe(console, run, shown[0])
    if not store.kept:
        console.print(
            "\ncandidate.py and its output are not here: the ledger came without its artifacts"
        )
        return
    text = store.text(shown[0].source)
    console.print("\ncandidate.py", style="bold")
    if console.is_terminal:
        from rich.syntax import Syntax

        console.print(Syntax(printable(text), "python", background_color="default", word_wrap=True))
    else:
        hand_over(f"{text}\n")


def _experiment_object(run: Run, experiment: Experiment) -> dict[str, object]:
    proposed, result, score = experiment.proposed, experiment.result, experiment.score
    model = _identified(run, experiment)
    return {
        "run": run.name,
        "experiment": experiment.number,
        "verdict": verdict_object(run.view) if run.view.best is experiment else None,
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
        **(identified_object(model) if model is not None else {"parameters": None}),
    }


def _identified(run: Run, experiment: Experiment) -> IdentifiedModel | None:
    """The parameters of a refit; those of the fold models where the experiment has none."""
    refitted = run.view.refitted
    if refitted is not None and refitted.experiment == experiment.number:
        return identified(run)
    if experiment.score is None or not run.store.kept:
        return None
    recipe = read_recipe(run.store.text(experiment.source))
    library = recipe is not None and recipe.package == MODELS
    return identified_by_folds(run, experiment, library=library)


def wide_console() -> Terminal:
    """Return a console with the terminal's width; wide in a pipe, so that no line is folded."""
    console = Terminal()
    return console if console.is_terminal else Terminal(width=200)


def describe(console: Terminal, run: Run, experiment: Experiment) -> None:
    """Print reasons, result, fold table and training-side evidence."""

    def row(label: str, text: str) -> None:
        console.print(printable_line(f"{label:<12}{text}"))

    view, p, r = run.view, experiment.proposed, experiment.result
    parent = f", derived from #{p.parent:02d}" if p.parent else ""
    title = Text(printable_line(f"#{p.experiment:02d} {p.title}"), style="bold")
    console.print(title, printable_line(f"(family {p.family}, {phase_text(p.phase)}{parent})"))
    row("hypothesis", p.hypothesis)
    row("expected", p.expected)
    if p.remark:
        row("remark", p.remark)
    row("result", describe_result(experiment, view))
    row("isolation", view.started.isolation_words)
    if r is None:
        return
    row("decision", r.status)
    if r.confirmation is not None:
        row("confirmation", confirmation_text(r.confirmation))
    refitted = view.refitted
    if refitted is not None and refitted.experiment != experiment.number:
        refitted = None
    for line in (*r.failed_checks, *(refitted.failed_checks if refitted else ())):
        row("note", line)
    if refitted and refitted.again:
        same = f"a second fit of fold {refitted.again.fold} gave the same result"
        row("second fit", again_words(view) or same)
    if view.confirmed is not None:
        for line in confirmation_lines(view.confirmed, view.v_name, experiment.number):
            row("confirmed", line)
    for line in (*verdict_lines(view), *use_lines(view)) if view.best is experiment else ():
        label, _, text = line.partition(" ")
        row(label, text.strip())
    if experiment.score:
        _print_folds(console, run, experiment)
    if experiment.failure and experiment.failure.detail:
        console.print("\ndetail", style="bold")
        console.print(experiment.failure.detail)
    if not run.store.kept:
        return
    model = _identified(run, experiment)
    if model is not None:
        console.print("\nidentified model", style="bold")
        for line in identified_lines(model):
            console.print(printable_line(line))
    evidence = evidence_of(experiment, view, run.store, settings_of_run(run.directory))
    if evidence.recorded:
        console.print("\nevidence", style="bold")
        for line in evidence_lines(evidence, experiment.seed_values):
            console.print(line)
    elif r.output:
        console.print("\nprinted while fitting (untrusted)", style="bold")
        for line in run.store.text(r.output).splitlines()[-20:]:
            console.print(line)


def _print_folds(console: Terminal, run: Run, experiment: Experiment) -> None:
    """Print a row per fold; many outputs get a table of their own."""
    score, result = experiment.score, experiment.result
    assert score is not None
    assert result is not None
    names, metric = run.view.started.outputs, run.metric
    heads = metric_label(metric), "fit %"
    asked = run.view.started.early_stopping == "validation"
    columns = sum(max(len(f"{head} {name}"), 7) + 2 for head in heads for name in names)
    left = console.width - _OTHER_COLUMNS - (13 if asked else 0)
    wide = len(names) > _MOST_OUTPUTS_AS_COLUMNS or columns > left
    # V, metric and fit index of each output on each fold.
    errors = [[f"{value:.4g}" for value in fold.per_channel(metric)] for fold in score.folds]
    fits = [["-" if v is None else f"{v:.1f}" for v in fold.fit_index] for fold in score.folds]

    table = Table(title="results of the folds", title_justify="left", box=None)
    for head in (
        *("fold", "V"),
        *(() if wide else (f"{head} {name}" for head in heads for name in names)),
        *(("val. scores",) if asked else ()),
        *("train", "bias", "white", "u-corr", "top", "start", "fit s"),
    ):
        table.add_column(head, justify="right", no_wrap=True)
    for k, (fold, kept) in enumerate(zip(score.folds, result.folds, strict=True)):
        d = kept.diagnostics
        table.add_row(
            str(k + 1),
            error_value(fold.value),
            *(() if wide else (*errors[k], *fits[k])),
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
    for k, kept in enumerate(result.folds, 1):
        if kept.attempt:
            console.print(
                f"fold {k}: the training error of the first fit was far above those of the other "
                f"folds; the fit from seed {kept.attempt + 1} fits the fold's own data best"
            )
    if wide:
        for head, values in zip(heads, (errors, fits), strict=True):
            table = Table(title=f"{head} by output", title_justify="left", box=None)
            table.add_column("output", overflow="fold")
            for k in range(1, len(score.folds) + 1):
                table.add_column(f"fold {k}", justify="right", no_wrap=True)
            for name, *row in zip(names, *values, strict=True):
                table.add_row(name, *row)
            console.print()
            console.print(table)

    ratio = consistency(score.value, [kept.diagnostics.train_error for kept in result.folds])
    text = f"{ratio:.2f}"
    if ratio < SUSPICIOUS_RATIO:
        text += ", suspiciously low"
        if result.status == "keep":
            text += "; V was the same when the folds were fitted again, one at a time"
    console.print(f"\nV divided by the training error: {text}")
