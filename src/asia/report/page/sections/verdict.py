"""Sections that decide: verdict, model to use, sealed test, accuracy."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any

from asia._text import one_line
from asia.judge.evaluation.references import CONTROLLERS
from asia.judge.scoring.checks.validation_data import listed
from asia.ledger.events import Refitted, TestedModel, Unsealed
from asia.ledger.evidence import identified
from asia.ledger.run import model_to_use, tested_model
from asia.ledger.verdict import alarms, unguarded, usability
from asia.ledger.view import Experiment
from asia.problem.metrics import find_metric
from asia.problem.problem import Problem
from asia.report.drawing.inline import PANEL
from asia.report.page.code import python
from asia.report.page.html import Html, facts, join, picture, said, table, tag
from asia.report.page.subject import Section, Subject, result_of
from asia.report.pictures.simulation import (
    Panel,
    draw_overlay,
    draw_tested,
    overlay_names,
    simulation_panels,
)
from asia.report.published import Board, read_board
from asia.report.simulated import final_models

# Five lines for someone who has to decide.


# Ratio of V to that of a reference model above which the model is hardly better.
_BETTER = 0.95


def _false_scores(subject: Subject) -> Iterator[str]:
    """Yield the alarms of the search, and whether V stands alone, without figures."""
    view, best = subject.view, subject.view.best
    if best is None or best.score is None:
        return
    found = alarms(view)
    below = view.below_truth(best.score.value)
    total = view.looks[-1].total if view.looks else None
    contradicted = total is not None and total.contradicted
    if len(found) > below + contradicted:
        yield "The test error is far above V, so V is no measure of this model."
    if contradicted:
        yield "The guard records contradict V, so V is no measure of this model."
    if words := unguarded(view):
        yield words
    if below:
        yield "V is below that of the simulated truth, so the candidate contains held-out data."


_COLOURS = {
    "usable": "good", "not validated": "shown", "doubtful": "doubt", "not usable": "none",
}  # fmt: skip


def stamp(subject: Subject) -> tuple[str, str]:
    """Return the verdict in two or three words, and its kind: `good`, `doubt` or `none`."""
    view = subject.view
    if view.best is None:
        return "No model", "none"
    judged = usability(view)
    kind = "not usable" if judged is None else judged.kind
    return kind.capitalize(), _COLOURS[kind]


_USES = {
    "ensemble": "the ensemble, the mean of the fold models",
    "refit": "the refit, the winner fitted to all training records",
    "stack": "the stack, a weighted mean of several candidates",
}


def _write(subject: Subject) -> Html | None:
    view, best, named = subject.view, subject.view.best, model_to_use(subject.view)
    if subject.run.state == "running" and not view.finished:
        return None
    text, kind = stamp(subject)
    control = subject.problem is not None and subject.problem.control is not None
    use = "" if named is None else _USES[named.model]
    if control and named is not None and named.model == "refit":
        use = "the one designed for all training scenarios"
    if best is None or named is None:
        count = subject.over("proposed", "experiment", "count", "count")
        lines = [join(("None of the candidates has a score. They were ", count, " in all."))]
    else:
        lines = [
            *(tag("b", said(words)) for words in _false_scores(subject)),
            _found(subject, best),
            _error(subject, best),
            _test(subject),
            join(("Controller to use: " if control else "Model to use: ", tag("b", use), ".")),
            _trust(subject, kind),
        ]
    if not view.complete and view.unsealed is None:
        lines.append(join(("The search is not finished: all of this may change.",)))
    verdict = tag("p", text, class_=f"stamp {kind}")
    listed_lines = tag("ol", *(tag("li", line) for line in lines), class_="verdict")
    return join((verdict, listed_lines, None if best is None else _tiles(subject, best)))


def _found(subject: Subject, best: Experiment) -> Html:
    view, held = subject.view, subject.view.incumbent
    rank = [") is the winner, the only candidate for "]
    if len(view.finished) > 1:
        count = subject.over("evaluated", "experiment", "count", "count")
        rank = [") is the winner, the best of ", count, " candidates for "]
    method: list[str] = []
    if held is not None and held.number != best.number:
        link = tag("a", subject.name(held), href=f"#e{held.number}")
        text = " Its own fit has the lowest V; it is statistically equal to experiment "
        method = [text, link, "."]
    number = tag("a", subject.name(best), href=f"#e{best.number}")
    title = tag("b", said(best.proposed.title))
    return join((title, " (experiment ", number, *rank, said(view.started.problem), ".", *method))


def _error(subject: Subject, best: Experiment) -> Html:
    result, score = result_of(best), best.score
    assert score is not None
    if subject.problem is not None and subject.problem.control is not None:
        cost = tag("b", subject.v(best))
        return join(("In held-out scenarios its errors are ", cost, " tolerances."))
    share = tag("b", subject.number(result, "outcome.value", "share"))
    start = ("On held-out data its error is ", share, " of the output's standard deviation")
    reference = subject.reference("linear model")
    if reference is None:
        return join((*start, "."))
    linear, value = reference
    other = subject.number(linear, "outcome.value", "share")
    if score.value <= _BETTER * value:
        pair = (linear, "outcome.value"), (result, "outcome.value")
        times = subject.made("ratio", "times", *pair)
        return join((*start, ". The best linear model has ", other, ", ", times, " times as much."))
    if value > _BETTER * score.value:
        return join((*start, ", no better than the best linear model with ", other, "."))
    return join((*start, ", worse than the best linear model with ", other, "."))


def _test(subject: Subject) -> Html:
    view, opened = subject.view, subject.view.unsealed
    if opened is None:
        text = "There is no sealed test, so no figure here is from unseen records."
        if any(one.record for one in view.validated):
            text = (
                "There is no sealed test. Only the validation on new records is of samples that "
                "the search did not see."
            )
        if view.started.test_digest is not None:
            text = (
                "The sealed test is still closed. The error above also served to choose the model, "
                "so expect a slightly larger error on new records."
            )
        return join((text,))
    named = model_to_use(view)
    use = named.model if named else "ensemble"
    model = tested_model(opened, use)
    if not isinstance(model, TestedModel):
        return join(("The model to use fails on the sealed test.",))
    place = use if getattr(opened, use) is not None else "ensemble"
    value = tag("b", subject.number(opened, f"{place}.scores.0.value", "sig4"))
    label = said(find_metric(model.scores[0].metric).label)
    units = {s.unit for s in subject.problem.outputs} if subject.problem else {""}
    known = units.pop() if len(units) == 1 else ""
    unit = join((" ", said(known))) if known else None
    text = "On the sealed test, which this run opened after the search, its "
    return join((text, label, " is ", value, unit, "."))


def _trust(subject: Subject, kind: str) -> Html:
    judged, view = usability(subject.view), subject.view
    found, parameters = identified(subject.run), ""
    if found is not None and found.disagreeing:
        parameters = (
            f" The folds disagree on {listed(found.disagreeing)}: the system drifts, or an effect "
            "is missing."
        )
    if judged is not None and kind in ("none", "doubt"):
        start = "Do not use this model" if kind == "none" else "Use it with care"
        return join((f"{start}. ", said(" ".join(judged.reasons), 2000), parameters))
    text = f"No candidate saw its validation data.{parameters}"
    if view.refitted and view.refitted.again:
        text += " Refitting the winner gave the same result."
    if subject.problem is not None and subject.problem.control is not None:
        return join((text.replace("validation data", "held-out scenarios"),))
    if kind == "good":
        return join((text, " No validation check failed."))
    command = tag("code", f"asia validate {view.started.run}")
    return join((text, " Its residuals and behaviour were not checked: run ", command, "."))


def _tiles(subject: Subject, best: Experiment) -> Html:
    result, score = result_of(best), best.score
    assert score is not None
    tiles: list[tuple[str, Html]] = [("V, winner", subject.v(best))]
    for label, name in (
        ("V, linear model", "linear model"),
        ("V, noise floor", "simulated truth"),
        ("V, training mean", "training mean"),
        *((f"V, {name}", name) for name in CONTROLLERS),
    ):
        reference = subject.reference(name)
        if reference is not None:
            tiles.append((label, subject.number(reference[0], "outcome.value", "error")))
    paths = [
        (result, f"outcome.folds.{k}.fit_index.{c}")
        for k, fold in enumerate(score.folds)
        for c, fit in enumerate(fold.fit_index)
        if fit is not None
    ]
    if paths:
        tiles.append(("lowest fit index", subject.made("least", "percent", *paths)))
    tiles.append(("experiments", subject.over("evaluated", "experiment", "count", "count")))
    tiles.append(("evaluation time", subject.over("evaluated", "seconds", "sum", "duration")))
    shown = [tag("div", tag("dt", label), tag("dd", value)) for label, value in tiles]
    return tag("dl", *shown, class_="tiles")


SECTION = Section("verdict", "Verdict", _write)


# The model to use, why this one, and how.


def _write_handover(subject: Subject) -> Html | None:
    view = subject.view
    named, refitted = model_to_use(view), view.refitted
    if named is None or (subject.problem is not None and subject.problem.control is not None):
        return None
    parts = [facts((("use", tag("b", named.model)), ("because", said(named.reason, 600))))]
    if refitted is not None:
        parts += _refitted(subject, refitted)
    name = one_line(view.started.run, 120).replace('"', "'")
    source = (
        f'import asia\n\nfound = asia.simulate("runs/{name}", past_u, past_y, u, bands=0.9)\n'
        "found.y_hat, found.lower, found.upper, found.outside\n"
    )
    return join((*parts, tag("h3", "In a program"),
                 python(source, "how to simulate with the model")))  # fmt: skip


def _refitted(subject: Subject, refitted: Refitted) -> Iterator[Html]:
    """Yield the final models, the stack, and the repeated fit."""
    check, stack, again = refitted.check, refitted.stack, refitted.again

    def value(path: str, known: float | None) -> Html | None:
        return None if known is None else subject.number(refitted, path, "error")

    rows: list[list[str | None]] = []
    if check is not None:
        for k, error in enumerate(check.fold_errors):
            name = join(("model of fold ", tag("span", f"{k + 1}", class_="fixed")))
            rows.append([name, value(f"check.fold_errors.{k}", error) or "no answer", None])
        if check.ensemble_error is not None:
            rows.append(["ensemble", value("check.ensemble_error", check.ensemble_error), None])
        for k, start in enumerate(check.starts):
            objection = join((" ", said(f"({start.objection})"))) if start.objection else None
            name = join(("refit" if check.kept == k + 1 else "refit, not used", objection))
            error = value(f"check.starts.{k}.error", start.error) or "no answer"
            apart = value(f"check.starts.{k}.disagreement", start.disagreement)
            rows.append([name, error, apart])
    if rows:
        head = [
            "model",
            "scaled error on the training records",
            "difference from the ensemble, in standard deviations of the output",
        ]
        yield table(head, rows, "Final models")
    if stack is not None:
        members: list[Html] = []
        for k in range(len(stack.members)):
            at = f"stack.members.{k}"
            weight = subject.number(refitted, f"{at}.weight", "fixed2")
            number = subject.number(refitted, f"{at}.experiment", "number")
            members.append(join((number, " with weight ", weight)))
        nested = subject.number(refitted, "stack.value", "error")
        yield tag(
            "p", "Stack: ", join(members, ", "), "; V by nested cross-validation ", nested, "."
        )
    if again is not None:
        fold = subject.number(refitted, "again.fold", "count")
        if again.ratio is None:
            yield tag("p", "A second fit of fold ", fold, " failed: ", said(again.failed), ".")
        elif again.ratio == 1.0:
            yield tag("p", "A second fit of fold ", fold, " gave the same result.")
        else:
            ratio = subject.number(refitted, "again.ratio", "sig4")
            yield tag(
                "p", "A second fit of fold ", fold, " has ", ratio, " times the error of the first."
            )


HANDOVER = Section("use", "The model to use", _write_handover)


# The sealed test, once it was opened.


def _write_tested(subject: Subject) -> Html | None:
    opened = subject.view.unsealed
    if opened is None:
        return None
    how: Html | None = None
    if opened.horizon is not None:
        how = join((" It is scored in windows of ",
                    subject.number(opened, "horizon", "count"), " samples."))  # fmt: skip
    elif opened.skip:
        how = join((" The first ", subject.number(opened, "skip", "count"),
                    " samples of each record do not count."))  # fmt: skip
    parts = [tag("p", "This run opened the test records once, after the search had ended.", how)]
    found = final_models(opened)
    failed = [text for _, text, model in found if not isinstance(model, TestedModel)]
    models = [(key, text, model) for key, text, model in found if isinstance(model, TestedModel)]
    if models:
        parts.append(_test_table(subject, opened, models))
    if failed:
        parts.append(tag("p", "No simulation from: ", ", ".join(failed), "."))
    if models and len(opened.trajectories) > 1:
        rows = [
            [
                said(name),
                *(
                    subject.number(opened, f"{key}.scores.0.per_trajectory.{i}", "sig4")
                    for key, _, _ in models
                ),
            ]
            for i, name in enumerate(opened.trajectories)
        ]
        head = ["record", *(text for _, text, _ in models)]
        parts.append(table(head, rows, "Error on each test record"))
    named = model_to_use(subject.view)
    chosen = next((m for m in models if named and m[0] == named.model), None)
    if chosen is not None and chosen[2].mee is not None:
        parts.append(_horizons(subject, opened, *chosen))
    if subject.problem is not None:
        board = read_board(subject.problem, subject.view)
        if board.entries and board.standings:
            parts.append(tag("h3", "Comparison with published results"))
            parts += [_board(board, index) for index in range(len(board.standings))]
        if models:
            parts.append(_draw_tested(subject, opened, *(chosen or models[0])[1:]))
    return join(parts)


def _test_table(
    subject: Subject, opened: Unsealed, models: Sequence[tuple[str, str, TestedModel]]
) -> Html:
    """A row for each metric and output, a column for each model."""
    rows: list[list[str | None]] = []
    for k, score in enumerate(models[0][2].scores):
        label = said(find_metric(score.metric).label)
        paths = [("mean over the outputs", "value")] if len(opened.channels) > 1 else []
        paths += [(name, f"per_channel.{c}") for c, name in enumerate(opened.channels)]
        for name, path in paths:
            places = [f"{key}.scores.{k}.{path}" for key, _, _ in models]
            values = [subject.number(opened, place, "sig4") for place in places]
            rows.append([join((label, " ", said(name))), *values])
    named = model_to_use(subject.view)
    use = named.model if named else ""
    head = ["error", *(f"{text} (to use)" if key == use else text for key, text, _ in models)]
    return table(head, rows, "Error on the sealed test, in the unit of the output")


def _horizons(subject: Subject, opened: Unsealed, key: str, text: str, model: TestedModel) -> Html:
    """Mean Euclidean Errors of the model to use."""
    assert model.mee is not None
    rows: list[list[str]] = []
    for i, group in enumerate(model.mee.groups):
        at = f"{key}.mee.groups.{i}.steps"
        values = [subject.number(opened, f"{at}.{h - 1}", "sig4") for h in model.mee.horizons]
        total = subject.made("sum", "sig4", (opened, f"{at}.*"))
        rows.append([said(group.name), *values, total])
    head = ["outputs", *(said(f"after {h}") for h in model.mee.horizons), "sum"]
    return table(head, rows, f"Mean Euclidean error after so many samples, {text}")


def _board(board: Board, index: int) -> Html:
    """Published results and ours, the lowest first. They are no events of this ledger, and the
    official figure is the one above in another unit, so both are quoted."""
    ours = board.standings[index]
    entries = [(e.figures[index], e.words) for e in board.entries if index < len(e.figures)]
    rows = [(v, text, False) for v, text in entries if v is not None]
    rows.append((ours.figure.value, "this search, the model to use", True))
    rows.sort(key=lambda row: row[0])
    bars: list[list[str]] = []
    for value, text, own in rows:
        share = f"width:{100 * value / rows[-1][0]:.1f}%"
        bar = tag("span", class_="bar own" if own else "bar", style=share)
        bars.append([tag("b", text) if own else said(text), said(f"{value:.4g}"), bar])
    caption = f"Test error of {ours.figure.name} [{board.unit}]"
    return table(["result", "error", "error as a bar"], bars, caption)


def _draw_tested(subject: Subject, opened: Unsealed, text: str, model: TestedModel) -> Html:
    assert subject.problem is not None
    problem, title = subject.problem, f"Sealed test: experiment {opened.experiment}"
    alt = f"Measured outputs of the test and the simulation of the {text}"
    draw = partial(draw_tested, subject.run, problem, opened, {text: model}, title)
    return picture(draw, alt)


TESTED = Section("test", "The sealed test", _write_tested)


# The winner on the data that it was not fitted to.


def _write_accuracy(subject: Subject) -> Html | None:
    best, problem = subject.view.best, subject.problem
    if best is None or (problem is not None and problem.control is not None):
        return None
    text = (
        "Each fold of the cross-validation held out a part of the training records. Its model "
        "simulated that part from its start, and received no measured output after the start."
    )
    return join((tag("p", text), _accuracy_table(subject, best), draw_held_out(subject, best)))


def _accuracy_table(subject: Subject, best: Experiment) -> Html:
    result, score, metric = result_of(best), best.score, find_metric(subject.run.metric)
    assert score is not None
    # Of many outputs the errors of each would not fit.
    outputs = subject.view.started.outputs if len(subject.view.started.outputs) <= 4 else ()
    head = ["fold", "V", *(join((said(metric.label), " ", said(name))) for name in outputs)]
    head += ["lowest fit index", "scaled error on its training data", "duration of the fit [s]"]
    field = metric.name if metric.name in ("rmse", "mae") else "other"
    rows: list[list[str]] = []
    for k, fold in enumerate(score.folds):
        at = f"outcome.folds.{k}"
        fits = [
            (result, f"{at}.fit_index.{c}") for c, f in enumerate(fold.fit_index) if f is not None
        ]
        rows.append([
            _fold_name(subject, k),
            subject.number(result, f"{at}.value", "error"),
            *(subject.number(result, f"{at}.{field}.{c}", "sig4") for c in range(len(outputs))),
            subject.made("least", "percent", *fits) if fits else "none",
            subject.number(result, f"folds.{k}.diagnostics.train_error", "error"),
            subject.number(result, f"folds.{k}.fit_seconds", "sig3"),
        ])  # fmt: skip
    return table(head, rows, "The winner on each fold")


def _fold_name(subject: Subject, fold: int) -> Html:
    names = subject.view.started.folds
    number = tag("span", f"{fold + 1}", class_="fixed")
    if fold >= len(names):
        return number
    # The block says nothing that the samples do not.
    return join((number, ": ", said(re.sub(r"^block \d+ of \d+: (?=samples)", "", names[fold]))))


def draw_held_out(subject: Subject, experiment: Experiment) -> Html | None:
    """Draw the simulations of an experiment's fold models on their held-out data, a picture for
    each output and fold; None without a score or the data."""
    problem = subject.problem
    if problem is None or experiment.score is None:
        return None
    panels, notes = simulation_panels(subject.run, problem, experiment, subject.folds)
    note = tag("p", said(notes.strip())) if notes else None
    shown = [draw_panel(problem, one) for one in panels]
    return join((note, tag("div", *shown, class_="grid")))


def draw_panel(problem: Problem, panel: Panel, alt: str = "", **settings: Any) -> Html:
    """Draw one panel as a picture.

    Args:
        alt: what it shows; default: its title.
        settings: as those of `draw_overlay`.
    """
    settings = {**overlay_names(problem), **settings}
    alt = f"{alt or panel.title}: measured and simulated {panel.signal.name}"
    draw = partial(draw_overlay, [panel], problem.sampling_time, "", **settings)
    return picture(draw, alt, PANEL)


ACCURACY = Section("accuracy", "Accuracy", _write_accuracy)
