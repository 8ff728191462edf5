"""Sections that decide: verdict, model to use, sealed test, accuracy."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from asia._text import one_line
from asia.data.trajectory import Array
from asia.judge.evaluation.results import SUSPICIOUS_RATIO, consistency
from asia.judge.scoring.checks.check import Verdict
from asia.judge.scoring.checks.records import listed
from asia.ledger.events import Refitted, TestedModel, Unsealed
from asia.ledger.evidence import identified
from asia.ledger.run import model_to_use, tested_model
from asia.ledger.view import Experiment
from asia.problem.metrics import find_metric
from asia.problem.problem import Problem
from asia.problem.protocol import Fold
from asia.report.drawing.places import time_unit
from asia.report.page.code import python
from asia.report.page.html import Html, facts, join, said, table, tag
from asia.report.page.subject import Section, Subject, result_of
from asia.report.page.svg import Curves, draw_curves, legend
from asia.report.pictures.simulation import lowest, telling, worst_fits
from asia.report.published import Board, read_board
from asia.report.simulated import fold_outputs

# Five lines for someone who has to decide.


# Ratio of V to that of a reference model above which the model is hardly better.
_BETTER = 0.95


def doubts(subject: Subject) -> Iterator[str]:
    """Yield the objections against the model and its figures, as sentences."""
    view = subject.view
    best = view.best
    if best is None or best.score is None:
        return
    value = best.score.value
    for name, text in (
        ("training mean", "than the mean of the data"),
        ("linear model", "than a linear one"),
    ):
        reference = subject.rung(name)
        if reference is not None and value > _BETTER * reference[1]:
            yield f"the model is {'worse' if value > reference[1] else 'hardly better'} {text}"
            break
    if view.started.isolation == "process":
        yield "candidates ran without isolation and could have read the held-out data"
    if view.started.early_stopping == "validation":
        yield "candidates saw their score on the held-out data during training"
    if view.started.residuals == "held_out":
        yield "the agent saw held-out residuals"
    again = view.refitted.again if view.refitted else None
    if again is not None and again.ratio != 1.0:
        yield "refitting the winner gave a different result"
    for validation in view.validated:
        where = f" on the record {validation.record}" if validation.record else ""
        for check in validation.checks:
            if check.verdict in (Verdict.DOUBT, Verdict.FAIL):
                ends = "fails" if check.verdict is Verdict.FAIL else "is in doubt"
                cause = f" ({check.cause})" if check.cause else ""
                yield f"the check '{check.name}' {ends}{where}{cause}"
    found = identified(subject.run)
    if found is not None and found.disagreeing:
        yield (
            f"the folds disagree on {listed(found.disagreeing)}: the system drifts, or an effect "
            "is missing"
        )
    result = result_of(best)
    if (
        consistency(value, [fold.diagnostics.train_error for fold in result.folds])
        < SUSPICIOUS_RATIO
    ):
        yield "the error on held-out data is far below that on training data"
    if result.deadline:
        yield "the winner's fit ran into its deadline, so it depends on the machine"


def stamp(subject: Subject) -> tuple[str, str]:
    """Return the verdict in two or three words, and its kind: `good`, `doubt` or `none`."""
    view = subject.view
    if view.best is None:
        return "No model", "none"
    raised = (Verdict.DOUBT, Verdict.FAIL)
    if any(c.weight > 1.0 and c.verdict in raised for d in view.validated for c in d.checks):
        return "Not usable", "none"
    if next(doubts(subject), None) is not None:
        return "Usable with limits", "doubt"
    return ("Usable", "good") if view.validated else ("A model was found, not validated", "shown")


def _write(subject: Subject) -> Html:
    view = subject.view
    best = view.best
    text, kind = stamp(subject)
    lines = [_nothing(subject)]
    if best is not None:
        lines = [
            _found(subject, best),
            _error(subject, best),
            _test(subject),
            _use(subject),
            _trust(subject, kind, list(doubts(subject))),
        ]
    if not view.complete and view.unsealed is None:
        lines.append(join(("The search is not finished: all of this may change.",)))
    tiles = None if best is None else _tiles(subject, best)
    return join(
        (
            tag("p", text, class_=f"stamp {kind}"),
            tag("ol", *(tag("li", line) for line in lines), class_="verdict"),
            tiles,
        )
    )


def _nothing(subject: Subject) -> Html:
    count = subject.over("proposed", "experiment", "count", "count")
    return join(("None of the candidates has a score. They were ", count, " in all."))


def _found(subject: Subject, best: Experiment) -> Html:
    view = subject.view
    count = subject.over("evaluated", "experiment", "count", "count")
    several, single = len(view.finished) > 1, ") is the only candidate for "
    return join(
        (
            tag("b", said(best.proposed.title)),
            " (experiment ",
            tag("a", subject.name(best), href=f"#e{best.number}"),
            *((") is the best of ", count, " candidates for ") if several else (single,)),
            said(view.started.problem),
            ".",
            *_method(subject, best),
        )
    )


def _method(subject: Subject, best: Experiment) -> tuple[Html | str, ...]:
    """Describe the method of the incumbent if the retests prefer another candidate."""
    held = subject.view.incumbent
    if held is None or held.number == best.number:
        return ()
    link = tag("a", subject.name(held), href=f"#e{held.number}")
    return (
        " Its own fit has the lowest V; it is statistically equal to experiment ",
        link,
        ".",
    )


def _error(subject: Subject, best: Experiment) -> Html:
    result = result_of(best)
    share = subject.number(result, "outcome.value", "share")
    start: tuple[str | None, ...] = (
        "On held-out data its error is ",
        tag("b", share),
        " of the output's standard deviation",
    )
    reference = subject.rung("linear model")
    if reference is None:
        return join((*start, "."))
    linear, value = reference
    own = subject.view.best
    assert own is not None
    assert own.score is not None
    other = subject.number(linear, "outcome.value", "share")
    if own.score.value <= _BETTER * value:
        first, second = (linear, "outcome.value"), (result, "outcome.value")
        times = subject.made("ratio", "times", first, second)
        return join((*start, ". The best linear model has ", other, ", ", times, " times as much."))
    if value > _BETTER * own.score.value:
        return join((*start, ", no better than the best linear model with ", other, "."))
    return join((*start, ", worse than the best linear model with ", other, "."))


def _test(subject: Subject) -> Html:
    view = subject.view
    opened = view.unsealed
    if opened is None:
        if view.started.test_digest is None:
            return join(("There is no sealed test, so no figure here is from unseen records.",))
        return join(
            (
                "The sealed test is still closed. The error above also served to choose the model, "
                "so expect a somewhat larger one.",
            )
        )
    named = model_to_use(view)
    use = named.model if named else "ensemble"
    model = tested_model(opened, use)
    if not isinstance(model, TestedModel):
        return join(("The model to use fails on the sealed test.",))
    place = use if getattr(opened, use) is not None else "ensemble"
    value = subject.number(opened, f"{place}.scores.0.value", "sig4")
    label = said(find_metric(model.scores[0].metric).label)
    units = {s.unit for s in subject.problem.outputs} if subject.problem else set[str]()
    unit = join((" ", said(units.pop()))) if len(units) == 1 else None
    return join(
        (
            "On the sealed test, opened once after the search, its ",
            label,
            " is ",
            tag("b", value),
            unit,
            ".",
        )
    )


def _use(subject: Subject) -> Html:
    named = model_to_use(subject.view)
    assert named is not None
    text = {
        "ensemble": "the ensemble, the mean of the fold models",
        "refit": "the refit, the winner fitted to all training records",
        "stack": "the stack, a weighted mean of several candidates",
    }[named.model]
    return join(("Model to use: ", tag("b", text), "."))


def _trust(subject: Subject, kind: str, against: list[str]) -> Html:
    if against:
        start = "Do not use this model" if kind == "none" else "Use it with limits"
        return join((f"{start}: ", said("; ".join(against), 2000), "."))
    view = subject.view
    again = (
        " Refitting the winner gave the same result."
        if view.refitted and view.refitted.again
        else ""
    )
    checked = (
        " No validation check failed or is in doubt."
        if view.validated
        else join((" Its residuals and behaviour were not checked: run ",
                   tag("code", f"asia validate {view.started.run}"), "."))
    )  # fmt: skip
    return join((f"No candidate saw its validation data.{again}", checked))


def _tiles(subject: Subject, best: Experiment) -> Html:
    result = result_of(best)
    tiles: list[tuple[str, Html]] = [("V, the best candidate", subject.v(best))]
    references = [
        ("V, best linear model", "linear model"),
        ("V, the noise floor", "simulated truth"),
        ("V, mean of the data", "training mean"),
    ]
    for label, name in references:
        reference = subject.rung(name)
        if reference is not None:
            tiles.append((label, subject.number(reference[0], "outcome.value", "error")))
    score = best.score
    assert score is not None
    paths = [
        (result, f"outcome.folds.{k}.fit_index.{c}")
        for k, fold in enumerate(score.folds)
        for c, fit in enumerate(fold.fit_index)
        if fit is not None
    ]
    if paths:
        tiles.append(("lowest fit index", subject.made("least", "percent", *paths)))
    tiles.append(("experiments", subject.over("evaluated", "experiment", "count", "count")))
    tiles.append(("spent on them", subject.over("evaluated", "seconds", "sum", "duration")))
    shown = [tag("div", tag("dt", label), tag("dd", value)) for label, value in tiles]
    return tag("dl", *shown, class_="tiles")


SECTION = Section("verdict", "Verdict", _write)


# The model to use, why this one, and how.


def _write_handover(subject: Subject) -> Html | None:
    view = subject.view
    named, refitted = model_to_use(view), view.refitted
    if named is None:
        return None
    parts: list[Html | None] = [
        facts((("use", tag("b", named.model)), ("because", said(named.reason, 600))))
    ]
    if refitted is not None:
        rows = list(_rows(subject, refitted))
        if rows:
            head = ["model", "error on the training records", "difference from the ensemble"]
            parts.append(table(head, rows, "Final models"))
        parts += [_stack(subject, refitted), _again(subject, refitted)]
    name = one_line(view.started.run, 120).replace('"', "'")
    source = (
        f'import asia\n\nfound = asia.simulate("runs/{name}", past_u, past_y, u, bands=0.9)\n'
        "found.y_hat, found.lower, found.upper, found.outside\n"
    )
    parts += [tag("h3", "In a program"), python(source, "how to simulate with the model")]
    return join(parts)


def _rows(subject: Subject, refitted: Refitted) -> Iterator[list[str | None]]:
    check = refitted.check
    if check is None:
        return
    for k, error in enumerate(check.fold_errors):
        name = join(("model of fold ", tag("span", f"{k + 1}", class_="fixed")))
        shown = (
            None if error is None else subject.number(refitted, f"check.fold_errors.{k}", "error")
        )
        yield [name, shown or "no answer", None]
    if check.ensemble_error is not None:
        yield ["ensemble", subject.number(refitted, "check.ensemble_error", "error"), None]
    for k, start in enumerate(check.starts):
        at = f"check.starts.{k}"
        kept = check.kept == k + 1
        error, apart = (
            None if value is None else subject.number(refitted, f"{at}.{name}", "error")
            for name, value in (("error", start.error), ("disagreement", start.disagreement))
        )
        objection = join((" ", said(f"({start.objection})"))) if start.objection else None
        yield [
            join(("refit" if kept else "refit, not used", objection)),
            error or "no answer",
            apart,
        ]


def _stack(subject: Subject, refitted: Refitted) -> Html | None:
    if refitted.stack is None:
        return None
    members = [
        join(
            (
                subject.number(refitted, f"stack.members.{k}.experiment", "number"),
                " with weight ",
                subject.number(refitted, f"stack.members.{k}.weight", "fixed2"),
            )
        )
        for k in range(len(refitted.stack.members))
    ]
    value = subject.number(refitted, "stack.value", "error")
    return tag("p", "Stack: ", join(members, ", "), "; nested V ", value, ".")


def _again(subject: Subject, refitted: Refitted) -> Html | None:
    again = refitted.again
    if again is None:
        return None
    fold = subject.number(refitted, "again.fold", "count")
    if again.ratio is None:
        return tag("p", "Fold ", fold, ", refitted, fails: ", said(again.failed), ".")
    if again.ratio == 1.0:
        return tag("p", "Fold ", fold, ", refitted, gave the same result.")
    ratio = subject.number(refitted, "again.ratio", "sig4")
    return tag("p", "Fold ", fold, ", refitted, has ", ratio, " times its error.")


HANDOVER = Section("use", "The model to use", _write_handover)


# Measured against simulated outputs, as the sections show them.


MOST_PANELS = 6
"""Maximum number of panels of a section."""


@dataclass(frozen=True)
class Overlay:
    """Measured and simulated output over one record, block or window."""

    title: Html
    """Title of the panel."""
    alt: str
    """The same for those who do not see it."""
    channel: int
    """Number of the output."""
    first: int
    """Number of the first sample in its record."""
    measured: Array
    """(H, ny)."""
    simulated: Array
    """(H, ny)."""
    skip: int = 0
    """Samples at the start that do not count."""
    band: tuple[Array, Array] | None = None
    """Lower and upper edges (H, ny) of the output bands; None without any."""

    def cut(self, first: int, last: int) -> Overlay:
        """Return the part between two samples, counted from its start and clipped to it; at least
        two samples.
        """
        begin = min(max(first, 0), len(self.measured) - 2)
        end = max(min(last + 1, len(self.measured)), begin + 2)
        return replace(
            self,
            first=self.first + begin,
            measured=self.measured[begin:end],
            simulated=self.simulated[begin:end],
            skip=max(0, min(self.skip, end) - begin),
            band=None if self.band is None else (self.band[0][begin:end], self.band[1][begin:end]),
        )


def draw_overlays(problem: Problem, overlays: Sequence[Overlay]) -> Html:
    """The first `MOST_PANELS`, with a legend."""
    shown = [draw_overlay(problem, one) for one in overlays[:MOST_PANELS]]
    banded = any(one.band is not None for one in overlays)
    return join((overlay_legend(banded=banded), tag("div", *shown, class_="grid")))


def overlay_legend(*, banded: bool = False) -> Html:
    """Write the legend of the curves. banded: true if output bands are among them."""
    text = [("measured", "measured"), ("model", "simulated"), ("error", "difference")]
    return legend([*text, *([("outputs", "output bands")] if banded else [])])


def draw_overlay(problem: Problem, overlay: Overlay) -> Html:
    """Draw one overlay."""
    signal = problem.outputs[overlay.channel]
    end = overlay.first + len(overlay.measured)
    unit = time_unit(problem.sampling_time * end)
    step = problem.sampling_time / unit.seconds
    return draw_curves(
        Curves(
            title=overlay.title,
            alt=f"{overlay.alt}: measured and simulated {signal.name}",
            axis=f"{signal.name} [{signal.unit}]" if signal.unit else signal.name,
            time=f"time [{unit.name}]",
            start=overlay.first * step,
            step=step,
            measured=overlay.measured[:, overlay.channel],
            simulated=overlay.simulated[:, overlay.channel],
            skip=overlay.skip,
            band=None
            if overlay.band is None
            else (overlay.band[0][:, overlay.channel], overlay.band[1][:, overlay.channel]),
        )
    )


# The sealed test, once it was opened.


_MODELS = (
    ("ensemble", "ensemble of the fold models"),
    ("refit", "refit on all training records"),
    ("stack", "stack of several experiments"),
)


def _write_tested(subject: Subject) -> Html | None:
    opened = subject.view.unsealed
    if opened is None:
        return None
    how = join((subject.number(opened, "skip", "count"), " samples of each record are left out"))
    if opened.horizon is not None:
        how = join(("windows of ", subject.number(opened, "horizon", "count"), " samples"))
    text = tag("p", "The test records were opened once, after the search had ended: ", how, ".")
    return join(
        (
            text,
            _table(subject, opened),
            _by_record(subject, opened),
            _horizons(subject, opened),
            _board(subject),
            _pictures(subject, opened),
        )
    )


def _models(opened: Unsealed) -> list[tuple[str, str, TestedModel]]:
    found = [(key, text, getattr(opened, key)) for key, text in _MODELS]
    return [(key, text, model) for key, text, model in found if isinstance(model, TestedModel)]


def _table(subject: Subject, opened: Unsealed) -> Html | None:
    """A row for each metric and output, a column for each model."""
    named, models = model_to_use(subject.view), _models(opened)
    failed = [text for key, text in _MODELS if _failed(opened, key)]
    note = tag("p", "No simulation from: ", ", ".join(failed), ".") if failed else None
    if not models:
        return note
    rows: list[list[str | None]] = []
    for k, score in enumerate(models[0][2].scores):
        label = said(find_metric(score.metric).label)
        paths = [("mean over the outputs", "value")] if len(opened.channels) > 1 else []
        paths += [(name, f"per_channel.{c}") for c, name in enumerate(opened.channels)]
        for name, path in paths:
            values = [
                subject.number(opened, f"{key}.scores.{k}.{path}", "sig4") for key, _, _ in models
            ]
            rows.append([join((label, " ", said(name))), *values])
    use = named.model if named else ""
    head = ["error", *(f"{text} (to use)" if key == use else text for key, text, _ in models)]
    return join((table(head, rows, "Error on the sealed test, in the unit of the output"), note))


def _horizons(subject: Subject, opened: Unsealed) -> Html | None:
    """The Mean Euclidean Errors of the model to use."""
    named = model_to_use(subject.view)
    models = [(key, text, model) for key, text, model in _models(opened) if model.mee]
    chosen = next((m for m in models if named and m[0] == named.model), None)
    if chosen is None or chosen[2].mee is None:
        return None
    key, text, mee = chosen[0], chosen[1], chosen[2].mee
    rows: list[list[str | None]] = []
    for i, group in enumerate(mee.groups):
        at = f"{key}.mee.groups.{i}.steps"
        values = [subject.number(opened, f"{at}.{h - 1}", "sig4") for h in mee.horizons]
        total = subject.made("sum", "sig4", (opened, f"{at}.*"))
        rows.append([said(group.name), *values, total])
    head = ["outputs", *(said(f"after {h}") for h in mee.horizons), "sum"]
    return table(head, rows, f"Mean Euclidean error after so many samples, {text}")


def _failed(opened: Unsealed, key: str) -> bool:
    model = getattr(opened, key)
    return model is not None and not isinstance(model, TestedModel)


def _by_record(subject: Subject, opened: Unsealed) -> Html | None:
    models = _models(opened)
    if len(opened.trajectories) < 2 or not models:
        return None
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
    return table(["record", *(text for _, text, _ in models)], rows, "Error on each test record")


def _board(subject: Subject) -> Html | None:
    if subject.problem is None:
        return None
    board = read_board(subject.problem, subject.view)
    if not board.entries or not board.standings:
        return None
    parts: list[Html] = [_board_of(board, index) for index in range(len(board.standings))]
    return join((tag("h3", "Comparison with published results"), *parts))


def _board_of(board: Board, index: int) -> Html:
    """Published results and ours, the lowest first. They are no events of this ledger, and the
    official figure is the one above in another unit, so both are quoted."""
    ours = board.standings[index]
    entries = [(e.figures[index], e.words) for e in board.entries if index < len(e.figures)]
    rows = [(v, text, False) for v, text in entries if v is not None]
    rows.append((ours.figure.value, "this search, the model to use", True))
    rows.sort(key=lambda row: row[0])
    most = rows[-1][0]
    bars: list[list[str | None]] = []
    for value, text, own in rows:
        share = f"width:{100 * value / most:.1f}%"
        bar = tag("span", class_="bar own" if own else "bar", style=share)
        name = tag("b", text) if own else said(text)
        bars.append([name, said(f"{value:.4g}"), bar])
    caption = f"Test error of {ours.figure.name} [{board.unit}]"
    return table(["result", "error", "size"], bars, caption)


def _pictures(subject: Subject, opened: Unsealed) -> Html | None:
    problem, models = subject.problem, _models(opened)
    if problem is None or not models or opened.horizon is not None:
        return None
    named = model_to_use(subject.view)
    chosen = next((m for m in models if named and m[0] == named.model), models[0])
    shapes = [(length, len(opened.channels)) for length in opened.lengths]
    measured = subject.run.store.get_arrays(opened.measured, shapes)
    simulated = subject.run.store.get_arrays(chosen[2].y_hat, shapes)
    edges = None
    if opened.bands is not None and opened.bands.model == chosen[0]:
        stored = (opened.bands.lower, opened.bands.upper)
        edges = [subject.run.store.get_arrays(one, shapes) for one in stored]
    parts = [
        Overlay(
            title=join((said(name), ", ", chosen[1])),
            alt=f"Test record {name}",
            channel=channel,
            first=problem.protocol.past,
            measured=measured[i],
            simulated=simulated[i],
            skip=opened.skip,
            band=None if edges is None else (edges[0][i], edges[1][i]),
        )
        for i, name in enumerate(opened.trajectories)
        for channel in range(len(problem.outputs))
    ]
    return draw_overlays(problem, parts)


TESTED = Section("test", "The sealed test", _write_tested)


# The winner on the data that it was not fitted to.


def _write_accuracy(subject: Subject) -> Html | None:
    best = subject.view.best
    if best is None:
        return None
    text = (
        "Each fold of the cross-validation held out a part of the training records. Its model "
        "simulated that part from its start, without seeing a measured output on the way."
    )
    return join((tag("p", text), _accuracy_table(subject, best), _accuracy_pictures(subject, best)))


def _accuracy_table(subject: Subject, best: Experiment) -> Html:
    result, score, metric = result_of(best), best.score, find_metric(subject.run.metric)
    assert score is not None
    outputs = subject.view.started.outputs
    wide = len(outputs) > 4
    head: list[str] = [
        "fold",
        "V",
        *([] if wide else [join((said(metric.label), " ", said(name))) for name in outputs]),
    ]
    head += ["lowest fit index", "error on its training data", "seconds of the fit"]
    field = metric.name if metric.name in ("rmse", "mae") else "other"
    rows: list[list[str | None]] = []
    for k, fold in enumerate(score.folds):
        at = f"outcome.folds.{k}"
        fits = [
            (result, f"{at}.fit_index.{c}") for c, f in enumerate(fold.fit_index) if f is not None
        ]
        errors = [subject.number(result, f"{at}.{field}.{c}", "sig4") for c in range(len(outputs))]
        rows.append(
            [
                _fold_name(subject, k),
                subject.number(result, f"{at}.value", "error"),
                *([] if wide else errors),
                subject.made("least", "percent", *fits) if fits else "none",
                subject.number(result, f"folds.{k}.diagnostics.train_error", "error"),
                subject.number(result, f"folds.{k}.fit_seconds", "sig3"),
            ]
        )
    return table(head, rows, "The winner on each fold")


def _fold_name(subject: Subject, fold: int) -> Html:
    names = subject.view.started.folds
    number = tag("span", f"{fold + 1}", class_="fixed")
    return join((number, ": ", said(names[fold]))) if fold < len(names) else number


def _accuracy_pictures(subject: Subject, best: Experiment) -> Html | None:
    problem, parts = subject.problem, held_out_overlays(subject, best)
    return draw_overlays(problem, parts) if problem is not None and parts else None


def held_out_overlays(subject: Subject, experiment: Experiment) -> list[Overlay]:
    """Return the simulations of an experiment's fold models on their held-out data, lowest fit
    first; none without a score or the data.
    """
    problem, score = subject.problem, experiment.score
    if problem is None or score is None:
        return []
    folds = subject.folds
    channels = lowest(worst_fits(score), max(1, MOST_PANELS // len(folds)))
    outputs = fold_outputs(subject.run.store, experiment, folds)
    windows = problem.protocol.kind == "windows"
    return [
        part
        for channel in channels
        for fold, y_hat in zip(folds, outputs, strict=True)
        for part in _parts(subject, fold, y_hat, channel, windows=windows)
    ]


def _parts(
    subject: Subject, fold: Fold, y_hat: Sequence[Array], channel: int, *, windows: bool
) -> Iterator[Overlay]:
    """The first block of a fold, or its best and its worst window."""
    chosen = [("held-out part", 0)]
    if windows:
        found = telling([block.y for block in fold.validation], y_hat, fold.scale)
        chosen = [(f"{word} window", index) for word, index in found if word != "median"]
    for what, index in chosen:
        block = fold.validation[index]
        yield Overlay(
            title=join((f"{what} of fold ", _fold_name(subject, fold.index))),
            alt=f"{what} of fold {fold.index + 1}",
            channel=channel,
            first=block.start,
            measured=block.y,
            simulated=y_hat[index],
        )


ACCURACY = Section("accuracy", "Accuracy", _write_accuracy)
