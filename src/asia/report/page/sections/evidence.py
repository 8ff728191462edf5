"""Sections of evidence: parameters, bands, confirmation, ablation, validation."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from asia._text import one_line
from asia.judge.scoring.checks.check import Verdict
from asia.ledger.events import Ablated, Confirmed, Validated
from asia.ledger.evidence import (
    DrawnCheck,
    EstimatedParameter,
    IdentifiedModel,
    IdentifiedParameter,
    get_curves,
    get_findings,
    identified,
)
from asia.ledger.run import Run
from asia.ledger.text import disagreement_lines
from asia.report.page.html import ONE, Html, facts, fixed, join, said, table, tag, write_number
from asia.report.page.subject import Section, Subject, used_no_test
from asia.report.page.svg import draw_panel

# Section of the ablation: contributions of the changes to the gain of the winner.


_PARTS = (
    ("its model, with the training of the baseline", "crossing.model"),
    ("its training, with the model of the baseline", "crossing.training"),
    ("interaction of both", "crossing.interaction"),
    ("in all", "crossing.gain"),
)


def _write(subject: Subject) -> Html | None:
    found = subject.view.ablated
    if found is None:
        return None
    text = tag(
        "p",
        "The winner was refitted with parts of its changes reverted, each variant with up to ",
        subject.number(found, "seeds", "count"),
        " seeds chosen by the evaluator.",
    )
    return join((text, _crossing(subject, found), _left_out(subject, found)))


def _crossing(subject: Subject, found: Ablated) -> Html:
    if found.crossing is None:
        return tag("p", "Model and training cannot be crossed: ", said(found.detail), ".")
    rows: list[list[str | None]] = [[text, _interval(subject, found, at)] for text, at in _PARTS]
    head = ["part of the winner", f"{subject.view.v_name} is lower by"]
    return table(head, rows, "Contributions to the gain over the baseline")


def _left_out(subject: Subject, found: Ablated) -> Html | None:
    if not found.left_out:
        return None
    rows: list[list[str | None]] = []
    for k, one in enumerate(found.left_out):
        at = f"left_out.{k}"
        loss = said(one.detail) if one.loss is None else _interval(subject, found, f"{at}.loss")
        rows.append([subject.number(found, f"{at}.experiment", "number"), loss])
    head = ["without the change of", f"{subject.view.v_name} is higher by"]
    return table(head, rows, "Each change of the lineage left out")


def _interval(subject: Subject, found: Ablated, at: str) -> Html:
    value, low, high = (
        subject.number(found, f"{at}.{end}", "signed_error") for end in ("value", "low", "high")
    )
    return join((value, " (", low, " to ", high, ")"))


SECTION = Section("ablation", "Ablation", _write)


# Section of the output bands: their coverage on the sealed test.


def _write_bands(subject: Subject) -> Html | None:
    opened = subject.view.unsealed
    if opened is None or opened.bands is None:
        return None
    bands = opened.bands
    pairs = (
        ("model", bands.model),
        ("nominal coverage", subject.number(opened, "bands.level", "share")),
        ("outside the region of validity", subject.number(opened, "bands.outside", "share")),
    )
    rows = [
        [said(name), subject.number(opened, f"bands.covered.{c}", "share")]
        for c, name in enumerate(opened.channels[: len(bands.covered)])
    ]
    head = ["output", "coverage of the test samples"]
    return join((facts(pairs), table(head, rows, "The bands on the sealed test")))


BANDS = Section("bands", "Output bands", _write_bands)


# Section of the confirmation: significance of the winner over repeated fits.


def _write_confirmation(subject: Subject) -> Html | None:
    found = subject.view.confirmed
    if found is None:
        return None
    text = tag(
        "p",
        "After the search the candidates with the lowest V were refitted on every fold, with ",
        subject.number(found, "seeds", "count"),
        " seeds chosen by the evaluator; once if their fits do not depend on the seed.",
    )
    after = used_no_test(found.after_unsealing)
    return join((text, _candidates(subject, found), _pairs(subject, found),
                 _expected(subject, found), after))  # fmt: skip


def _candidates(subject: Subject, found: Confirmed) -> Html | None:
    if not found.candidates:
        return tag("p", "None of them has a score with another seed.")
    rows: list[list[str | None]] = []
    for k, one in enumerate(found.candidates):
        at = f"candidates.{k}"
        ranks = [subject.number(found, f"{at}.best_rank", "count")]
        if one.worst_rank != one.best_rank:
            ranks += [Html(" to "), subject.number(found, f"{at}.worst_rank", "count")]
        spread = None if one.spread is None else subject.number(found, f"{at}.spread", "sig2")
        rows.append([
            subject.number(found, f"{at}.experiment", "number"),
            join(ranks),
            _confirmation_interval(subject, found, f"{at}.value", "error"),
            subject.number(found, f"{at}.first", "error"),
            "fits do not depend on the seed" if one.deterministic else spread,
            subject.number(found, f"{at}.failed", "count"),
        ])  # fmt: skip
    name = subject.view.v_name
    head = ["experiment", "rank", f"{name} over the seeds", f"{name} in the search",
            "standard deviation over the seeds", "failed seeds"]  # fmt: skip
    return table(head, rows, "Refitted candidates")


def _pairs(subject: Subject, found: Confirmed) -> Html | None:
    if not found.pairs:
        return None
    rows: list[list[str | None]] = []
    for k, pair in enumerate(found.pairs):
        at = f"pairs.{k}"
        names = [subject.number(found, f"{at}.{side}", "number") for side in ("first", "second")]
        text = "is better" if pair.apart else "statistically equal"
        gap = _confirmation_interval(subject, found, f"{at}.difference", "signed_error")
        rows.append([join(names, " and "), gap, text])
    note = tag(
        "p",
        "The intervals hold simultaneously at ",
        subject.number(found, "level", "share"),
        ", corrected for the selection among ",
        subject.number(found, "tried", "count"),
        " candidates.",
    )
    return join((table(["pair", "difference of V", "verdict"], rows, "Pairwise differences"), note))


def _expected(subject: Subject, found: Confirmed) -> Html:
    noise = None
    if found.noise is not None:
        noise = join(
            (
                "The noise floor, the standard deviation of V from seed to seed, is ",
                subject.number(found, "noise", "sig2"),
                ". ",
            )
        )
    if found.expected is None:
        return tag("p", noise, "The expected error of the winner is unknown: its repeats failed.")
    ensemble = None
    if found.ensemble is not None:
        ensemble = join(
            (
                "; their ensemble one of ",
                _confirmation_interval(subject, found, "ensemble", "error"),
            )
        )
    return tag(
        "p",
        noise,
        "On a new record of the same kind, as long as a fold, one of its fold models is expected "
        "to have an error of ",
        _confirmation_interval(subject, found, "expected", "error"),
        ", at a level of ",
        subject.number(found, "expected_level", "share"),
        ensemble,
        "; of this ",
        subject.number(found, "expected.optimism", "sig2"),
        " corrects for the selection of the best.",
    )


def _confirmation_interval(subject: Subject, found: Confirmed, at: str, form: str) -> Html:
    value, low, high = (
        subject.number(found, f"{at}.{end}", form) for end in ("value", "low", "high")
    )
    return join((value, " (", low, " to ", high, ")"))


CONFIRMATION = Section("confirmation", "Significance", _write_confirmation)


# The equations and parameters of the winner, fitted to all training records.


_MOST_PAIRS = 5
_LONGEST = 600


def _write_identified(subject: Subject) -> Html | None:
    found = identified(subject.run)
    if found is None or not (found.equations or found.parameters):
        return None
    return join(
        (_equations(found), _parameters(subject.run, found), _entangled(subject.run, found))
    )


def _equations(found: IdentifiedModel) -> Html | None:
    if not found.equations:
        return None
    lines = "\n".join(one_line(line, _LONGEST) for line in found.equations)
    return join((tag("p", "The equations of the winner, with the fitted numbers:"),
                 tag("pre", tag("code", lines), tabindex="0")))  # fmt: skip


def _parameters(run: Run, found: IdentifiedModel) -> Html | None:
    if not found.parameters:
        return None
    rows = [_row(run, k, one) for k, one in enumerate(found.parameters)]
    head = ["parameter", "value", "unit", "standard error", "standard error by folds", "interval",
            "decided by", "remark"]  # fmt: skip
    text = tag(
        "p",
        "The intervals are those of ",
        fixed("95 %"),
        ": the widest of what noise, the spread of the fold models, and a missing effect that the "
        "residuals show would give.",
    )
    apart = [tag("p", tag("b", said(line), ".")) for line in disagreement_lines(found)]
    return join((table(head, rows, "Parameters, fitted to all training records"), *apart, text))


def _row(run: Run, place: int, one: IdentifiedParameter) -> list[str | None]:
    at, fitted, error = f"parameters.{place}", one.fitted, one.fitted.standard_error
    return [
        said(fitted.name),
        _number(run, f"{at}.value", fitted.value, "sig5"),
        said(fitted.unit),
        None if error is None else _number(run, f"{at}.standard_error", error, "sig2"),
        None
        if one.fold_error is None
        else _of_folds(run, one, [f"{at}.value"], [fitted.value], "jackknife", "sig2"),
        _identified_interval(run, at, one),
        None if one.interval is None else one.decided_by,
        _remark(fitted),
    ]


def _identified_interval(run: Run, at: str, one: IdentifiedParameter) -> Html | None:
    fitted = one.fitted
    if one.interval is None or fitted.low is None or fitted.high is None:
        return None
    paths = [f"{at}.{name}" for name in ("value", "low", "high", "lower")]
    values = [fitted.value, fitted.low, fitted.high, fitted.lower]
    ends: list[Html] = []
    for place, end in enumerate(("low", "high"), 1):
        if one.decided_by == "folds":
            ends.append(_of_folds(run, one, paths, values, f"folds_{end}", "sig4"))
        elif one.decided_by == "missing effect":
            sources = _sources(run, [*paths, f"{at}.misfit_error"])
            every = [*values, fitted.misfit_error]
            ends.append(write_number(every, sources, f"effect_{end}", "sig4"))
        else:
            ends.append(write_number([values[place]], _sources(run, [paths[place]]), ONE, "sig4"))
    return join(ends, " to ")


def _of_folds(
    run: Run, one: IdentifiedParameter, paths: Sequence[str], values: Sequence[float | None],
    rule: str, form: str,
) -> Html:  # fmt: skip
    """A number of the refit and of the fold models."""
    refitted = run.view.refitted
    assert refitted is not None
    result = run.view.experiment(refitted.experiment).result
    assert result is not None
    sources = [_sources(run, paths)]
    for fold in result.folds:
        if fold.findings is not None:
            names = [name for name, _ in get_findings(run.store, fold.findings).parameters]
            sources.append(f"{fold.findings}:parameters.{names.index(one.fitted.name)}.1")
    return write_number([*values, *one.folds], " ".join(sources), rule, form)


def _sources(run: Run, paths: Sequence[str]) -> str:
    """Places in the artifact that the record of the refit names."""
    assert run.view.refitted is not None
    return " ".join(f"{run.view.refitted.estimates}:{path}" for path in paths)


def _remark(one: EstimatedParameter) -> str:
    remarks = [] if one.identifiable else ["not identifiable from these records"]
    if one.at_bound:
        remarks.append(f"at the {one.at_bound} end of its range")
    return "; ".join(remarks)


def _entangled(run: Run, found: IdentifiedModel) -> Html | None:
    names = [one.fitted.name for one in found.parameters]
    rows = [
        [
            join((said(a), " and ", said(b))),
            _number(run, f"correlation.{names.index(a)}.{names.index(b)}", rho, "signed_fixed3"),
        ]
        for a, b, rho in found.entangled[:_MOST_PAIRS]
    ]
    if not rows:
        return None
    return table(["pair", "correlation of the errors"], rows, "Poorly distinguished by the records")


def _number(run: Run, path: str, value: float, form: str) -> Html:
    return write_number([value], _sources(run, [path]), ONE, form)


IDENTIFIED = Section("identified", "Identified parameters", _write_identified)


# Section of the validation: objections against the use of the model.


_KINDS: Final = {Verdict.PASS: "good", Verdict.DOUBT: "doubt", Verdict.FAIL: "none"}
_LOGARITHMIC: Final = frozenset({"frequency response", "error spectrum"})


def _write_validation(subject: Subject) -> Html | None:
    found = subject.view.validated
    return join([_report(subject, one) for one in found]) if found else None


def _report(subject: Subject, found: Validated) -> Html:
    title = "On the held-out data"
    if found.record:
        title = join(("On the new record ", said(found.record)))
    counts = tag(
        "p",
        "Checks that pass: ",
        subject.number(found, "passed", "count"),
        "; in doubt: ",
        subject.number(found, "doubtful", "count"),
        "; that fail: ",
        subject.number(found, "failed", "count"),
        ". What was checked is the ",
        found.model,
        " of experiment ",
        subject.number(found, "experiment", "number"),
        ".",
    )
    after = used_no_test(found.after_unsealing)
    return join(
        (tag("h3", title), counts, _worst(subject, found), after, _table(subject, found),
         _pictures(subject, found))
    )  # fmt: skip


def _worst(subject: Subject, found: Validated) -> Html | None:
    for k, one in enumerate(found.checks):
        if one.name == found.worst:
            text = subject.number(found, f"checks.{k}.sentence", "text")
            return tag("p", tag("b", "Most important: "), text, ".", class_="sentence")
    return None


def _table(subject: Subject, found: Validated) -> Html:
    rows = [
        tag(
            "tr",
            tag("th", one.name, scope="row"),
            tag("td", tag("span", str(one.verdict), class_=f"stamp small {_kind(one.verdict)}")),
            tag("td", subject.number(found, f"checks.{k}.sentence", "text")),
        )
        for k, one in enumerate(found.checks)
    ]
    head = [tag("th", text, scope="col") for text in ("check", "verdict", "finding")]
    inner = tag(
        "table",
        tag("caption", "Validation checks"),
        tag("thead", tag("tr", *head)),
        tag("tbody", *rows),
    )
    label = f"Validation checks, {found.record or 'held-out parts'}"
    return tag("div", inner, class_="scroll dossier", tabindex="0", role="region", aria_label=label)


def _kind(verdict: Verdict) -> str:
    return _KINDS.get(verdict, "shown")


def _pictures(subject: Subject, found: Validated) -> Html | None:
    if not subject.run.store.kept:
        return None
    drawn: tuple[DrawnCheck, ...] = get_curves(subject.run.store, found.curves)
    panels = [draw_panel(one, log=one.name in _LOGARITHMIC) for one in drawn]
    return tag("div", *panels, class_="grid") if panels else None


VALIDATION = Section("validation", "Validation", _write_validation)
