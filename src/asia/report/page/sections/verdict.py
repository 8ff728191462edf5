"""Sections that decide: verdict, model to use, sealed test, accuracy."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Any

from markupsafe import Markup

from asia._text import one_line
from asia._timer import duration
from asia.analysis.verdict import alarms, unguarded, usability
from asia.judge.evaluation.references import CONTROLLERS
from asia.judge.scoring.outcome import Score
from asia.ledger.events import TestedModel, Unsealed, Use
from asia.ledger.evidence import identified
from asia.ledger.run import final_models, model_to_use, tested_model
from asia.ledger.view import Experiment, SearchView
from asia.presentation.experiments import fold_blocks, method_note
from asia.presentation.parameters import disagreement_text
from asia.presentation.results import (
    final_models_table,
    sealed_test_blocks,
    second_fit_text,
    stack_text,
    use_text,
)
from asia.presentation.table import FORMATS, Block
from asia.problem.metrics import find_metric
from asia.problem.problem import Problem
from asia.report.drawing.inline import PANEL
from asia.report.page.render import picture, render, show
from asia.report.page.subject import Section, Subject
from asia.report.pictures.simulation import (
    Panel,
    draw_overlay,
    draw_tested,
    overlay_names,
    simulation_panels,
)
from asia.report.published import Board, read_board

# Five lines for someone who has to decide.


# Ratio of V to that of a reference model above which the model is hardly better.
_BETTER = 0.95


_COLOURS = {
    "usable": "good", "not validated": "shown", "doubtful": "doubt", "not usable": "none",
}  # fmt: skip


def stamp(view: SearchView) -> tuple[str, str]:
    """Return the verdict in two or three words, and its kind: `good`, `doubt` or `none`."""
    if view.best is None:
        return "No model", "none"
    judged = usability(view)
    kind = "not usable" if judged is None else judged.kind
    return kind.capitalize(), _COLOURS[kind]


def _content(subject: Subject) -> dict[str, Any] | None:
    view, best, named = subject.view, subject.view.best, model_to_use(subject.view)
    if subject.run.state == "running" and not view.finished:
        return None
    text, kind = stamp(view)
    use = "" if named is None else use_text(named.model, view.refitted)
    designed = view.refitted is not None and not view.refitted.fold
    if subject.is_control and named is not None and named.model == "refit" and designed:
        use = "the one designed for all training scenarios"
    if best is None or best.score is None or named is None:
        return {"stamp": text, "kind": kind, "use": None}
    tested = view.unsealed
    return {
        "stamp": text,
        "kind": kind,
        "use": use,
        "alarms": [*alarms(view), *filter(None, [unguarded(view)])],
        "method": method_note(view),
        "compared": _compared(subject, best.score.value),
        "sealed": sealed_sentence(view) if tested is None else None,
        "tested": None if tested is None else tested_figure(tested, named.model),
        "unit": _common_unit(subject),
        "trust": _trust(subject, kind),
        "tiles": list(_tiles(subject, best, best.score)),
    }


def _compared(subject: Subject, value: float) -> str:
    """Compare the V of the best with that of the best linear model, as the end of a sentence."""
    linear = subject.reference("linear model")
    if linear is None:
        return "."
    other = FORMATS["share"](linear)
    if value <= _BETTER * linear:
        times = FORMATS["times"](linear / value)
        return f". The best linear model has {other}, {times} times as much."
    if linear > _BETTER * value:
        return f", no better than the best linear model with {other}."
    return f", worse than the best linear model with {other}."


def sealed_sentence(view: SearchView) -> str:
    """Say what a test that is not open means for the figures."""
    if view.started.test_digest is not None:
        return (
            "The sealed test is still closed. The error above also served to choose the model, so "
            "expect a slightly larger error on new records."
        )
    if any(one.record for one in view.validated):
        return (
            "There is no sealed test. Only the validation on new records is of samples that the "
            "search did not see."
        )
    return "There is no sealed test, so no figure here is from unseen records."


def tested_figure(opened: Unsealed, use: Use) -> tuple[str, str] | None:
    """Return the metric and the error of the model to use on the test; None where it fails."""
    model = tested_model(opened, use)
    if not isinstance(model, TestedModel):
        return None
    score = model.scores[0]
    return find_metric(score.metric).label, FORMATS["sig"](score.value)


def _common_unit(subject: Subject) -> str:
    units = {s.unit for s in subject.problem.outputs} if subject.problem else {""}
    return units.pop() if len(units) == 1 else ""


def _trust(subject: Subject, kind: str) -> str:
    judged, view = usability(subject.view), subject.view
    found, parameters = identified(subject.run), ""
    if found is not None and found.disagreeing:
        parameters = f" Parameters {disagreement_text(found.disagreeing)}."
    if judged is not None and kind in ("none", "doubt"):
        start = "Do not use this model" if kind == "none" else "Use it with care"
        return f"{start}. {one_line(' '.join(judged.reasons), 2000)}{parameters}"
    text = f"No candidate saw its validation data.{parameters}"
    if view.refitted and view.refitted.again:
        again = second_fit_text(view.refitted.again)
        text += f" {again[:1].upper()}{again[1:]}."
    if subject.is_control:
        return text.replace("validation data", "held-out scenarios")
    if kind == "good":
        return f"{text} No validation check failed."
    return f"{text} Its residuals and behaviour were not checked: run "


def _tiles(subject: Subject, best: Experiment, score: Score) -> Iterator[tuple[str, str]]:
    yield "V, best candidate", subject.v(best)
    for label, name in (
        ("V, linear model", "linear model"),
        ("V, noise floor", "simulated truth"),
        ("V, training mean", "training mean"),
        *((f"V, {name}", name) for name in CONTROLLERS),
    ):
        value = subject.reference(name)
        if value is not None:
            yield label, FORMATS["error"](value)
    fits = [fold.worst_fit for fold in score.folds if fold.worst_fit is not None]
    if fits:
        yield "lowest fit index", FORMATS["percent"](min(fits))
    yield "experiments", str(len(subject.evaluations))
    yield "evaluation time", duration(subject.seconds)


SECTION = Section("verdict", "Verdict", _content)


# The model to use, why this one, and how.


def _handover(subject: Subject) -> dict[str, Any] | None:
    view = subject.view
    named, refitted = model_to_use(view), view.refitted
    if named is None or subject.is_control:
        return None
    name = one_line(view.started.run, 120).replace('"', "'")
    source = (
        f'import asia\n\nfound = asia.simulate("runs/{name}", past_u, past_y, u, bands=0.9)\n'
        "found.y_hat, found.lower, found.upper, found.outside\n"
    )
    blocks: list[Block] = []
    if refitted is not None:
        if refitted.check is not None:
            blocks.append(final_models_table(refitted.check, refitted.fold))
        if refitted.stack is not None:
            blocks.append(f"stack: {stack_text(refitted.stack, view.v_name)}")
        if refitted.again is not None:
            blocks.append(second_fit_text(refitted.again))
    return {"named": named, "blocks": show(blocks), "source": source}


HANDOVER = Section("use", "The model to use", _handover)


# The sealed test, once it was opened.


def _tested(subject: Subject) -> dict[str, Any] | None:
    opened = subject.view.unsealed
    if opened is None:
        return None
    models = {k: m for k, m in final_models(opened).items() if isinstance(m, TestedModel)}
    named = model_to_use(subject.view)
    use = named.model if named else None
    boards: list[Any] = []
    drawn: Markup | None = None
    total = True
    if subject.problem is not None:
        board = read_board(subject.problem, subject.view)
        total = board.unit_is_outputs
        boards = [_board(board, k) for k in range(len(board.standings) if board.entries else 0)]
    if subject.problem is not None and models:
        name = use if use in models else next(iter(models))
        title = f"Sealed test: experiment {opened.experiment}"
        alt = f"Measured outputs of the test and the simulation of the {name}"
        shown = {str(name): models[name]}
        draw = partial(draw_tested, subject.run, subject.problem, opened, shown, title)
        drawn = picture(draw, alt)
    blocks = show(sealed_test_blocks(opened, use, total=total))
    return {"blocks": blocks, "boards": boards, "drawn": drawn}


def _board(board: Board, index: int) -> tuple[str, list[tuple[str, float, bool, float]]]:
    """Return the caption, and published results and ours, the lowest first: name, error, whether it
    is ours, and length of the bar in per cent."""
    ours = board.standings[index]
    entries = [(e.figures[index], e.words) for e in board.entries if index < len(e.figures)]
    rows = [(v, text, False) for v, text in entries if v is not None]
    rows.append((ours.figure.value, "this search, the model to use", True))
    rows.sort(key=lambda row: row[0])
    bars = [(text, value, own, 100 * value / rows[-1][0]) for value, text, own in rows]
    return f"Test error of {ours.figure.name} [{board.unit}]", bars


TESTED = Section("test", "The sealed test", _tested)


# The best candidate on the data that it was not fitted to.


def _accuracy(subject: Subject) -> list[Block] | None:
    best = subject.view.best
    if best is None or best.score is None or subject.is_control:
        return None
    drawn = draw_held_out(subject, best)
    return [
        "Each fold of the cross-validation held out a part of the training records. Its model "
        "simulated that part from its start, and received no measured output after the start.",
        *fold_blocks(best, subject.view, subject.run.metric),
        *([drawn] if drawn else []),
    ]


def draw_held_out(subject: Subject, experiment: Experiment) -> Markup | None:
    """Draw the simulations of an experiment's fold models on their held-out data, a picture for
    each output and fold; None without a score or the data."""
    problem = subject.problem
    if problem is None or experiment.score is None:
        return None
    panels, notes = simulation_panels(subject.run, problem, experiment, subject.folds)
    drawn = [draw_panel(problem, one) for one in panels]
    return render("panels.html", notes=notes, drawn=drawn)


def draw_panel(problem: Problem, panel: Panel, alt: str = "", **settings: Any) -> Markup:
    """Draw one panel as a picture.

    Args:
        alt: what it shows; default: its title.
        settings: as those of `draw_overlay`.
    """
    settings = {**overlay_names(problem), **settings}
    alt = f"{alt or panel.title}: measured and simulated {panel.signal.name}"
    draw = partial(draw_overlay, [panel], problem.sampling_time, "", **settings)
    return picture(draw, alt, PANEL)


ACCURACY = Section("accuracy", "Accuracy", _accuracy)
