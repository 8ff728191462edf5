"""asia show: one experiment, or two side by side."""

import difflib
import json
from collections.abc import Iterable
from typing import Annotated

import typer
from rich.text import Text

from asia._text import hand_over, printable, printable_line, say
from asia.errors import UserError
from asia.interfaces.cli.options import DEFAULT_RUNS, Json, Runs, run_directory
from asia.interfaces.cli.output import Terminal, print_alarms, verdict_facts, verdict_object
from asia.ledger.evidence import IdentifiedModel, identified, identified_by_folds
from asia.ledger.run import Run, open_run
from asia.ledger.view import Experiment
from asia.presentation.evidence import recorded_evidence
from asia.presentation.experiments import describe_result, experiment_facts, fold_blocks
from asia.presentation.integrity import isolation_text, seal_text
from asia.presentation.parameters import identified_blocks, identified_object
from asia.presentation.results import confirmation_blocks, second_fit_text
from asia.presentation.table import block_lines
from asia.recipe import MODELS, read_recipe


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
    if said := seal_text(run.directory, view):
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
        "agent": proposed.agent or run.view.started.agent,
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

    def part(title: str, lines: Iterable[str]) -> None:
        for k, line in enumerate(lines):
            if k == 0:
                console.print(f"\n{title}", style="bold")
            console.print(printable_line(line))

    view, p, r = run.view, experiment.proposed, experiment.result
    console.print(printable_line(f"#{p.experiment:02d} {p.title}"), style="bold")
    for label, text in experiment_facts(experiment, view):
        row(label, text)
    row("isolation", isolation_text(view.started))
    if r is None:
        return
    refitted = view.refitted
    if refitted is not None and refitted.experiment != experiment.number:
        refitted = None
    for line in refitted.failed_checks if refitted else ():
        row("note", line)
    if refitted and refitted.again:
        row("second fit", second_fit_text(refitted.again))
    for label, text in verdict_facts(view) if view.best is experiment else ():
        row(label, text)
    if experiment.score:
        part("folds", block_lines(fold_blocks(experiment, view, run.metric)))
    if view.confirmed is not None:
        found = confirmation_blocks(view.confirmed, view.v_name, experiment.number)
        part("repeated fits", block_lines(found))
    if experiment.failure and experiment.failure.detail:
        part("detail", experiment.failure.detail.splitlines())
    if not run.store.kept:
        return
    model = _identified(run, experiment)
    if model is not None:
        part("identified model", block_lines(identified_blocks(model)))
    part("evidence", recorded_evidence(run, experiment))
