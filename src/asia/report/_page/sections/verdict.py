"""Five lines for someone who has to decide."""

from __future__ import annotations

from collections.abc import Iterator

from asia.evaluation import FAR_BELOW, consistency
from asia.ledger import Experiment, TestedModel, identified, model_to_use, tested_model
from asia.protocol import find_metric
from asia.report._page.html import Html, join, said, tag
from asia.report._page.section import Section
from asia.report._page.subject import Subject, result_of
from asia.scoring.dossier import Verdict
from asia.scoring.dossier.records import listed

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
    if consistency(value, [fold.diagnostics.train_error for fold in result.folds]) < FAR_BELOW:
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
