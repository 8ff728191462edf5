"""Sections of evidence: parameters, bands, confirmation, ablation, validation."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter

from asia._files import read_file
from asia._text import one_line
from asia.judge.scoring.checks.check import Verdict
from asia.ledger.events import Confirmed, Validated
from asia.ledger.evidence import (
    DrawnCheck,
    IdentifiedModel,
    IdentifiedParameter,
    get_curves,
    get_findings,
    identified,
)
from asia.ledger.run import Run
from asia.ledger.text import interval_lines, parameter_remarks
from asia.report.drawing.inline import PANEL
from asia.report.page.html import (
    ONE,
    Html,
    facts,
    fixed,
    join,
    picture,
    region,
    said,
    table,
    tag,
    write_number,
)
from asia.report.page.subject import Section, Subject, used_no_test
from asia.report.pictures.analysis import draw_poles
from asia.report.pictures.evidence import draw_check

# The ablation: contributions of the changes to the gain of the winner.


_PARTS = (
    ("its model, with the training of the baseline", "crossing.model"),
    ("its training, with the model of the baseline", "crossing.training"),
    ("interaction of both", "crossing.interaction"),
    ("in all", "crossing.gain"),
)


def _write(subject: Subject) -> Html | None:
    found, name = subject.view.ablated, subject.view.v_name
    if found is None:
        return None
    text = tag(
        "p",
        "The winner was refitted with parts of its changes reverted, each variant with up to ",
        subject.number(found, "seeds", "count"),
        " seeds chosen by the evaluator.",
    )
    crossing = tag("p", "Model and training cannot be crossed: ", said(found.detail), ".")
    if found.crossing is not None:
        rows = [[part, subject.interval(found, at, "signed_error")] for part, at in _PARTS]
        head = ["part of the winner", f"{name} is lower by"]
        crossing = table(head, rows, "Contributions to the gain over the baseline")
    changes = None
    if found.left_out:
        rows: list[list[str]] = []
        for k, one in enumerate(found.left_out):
            loss = said(one.detail)
            if one.loss is not None:
                loss = subject.interval(found, f"left_out.{k}.loss", "signed_error")
            rows.append([subject.number(found, f"left_out.{k}.experiment", "number"), loss])
        head = ["without the change of", f"{name} is higher by"]
        changes = table(head, rows, "Each change of the lineage left out")
    return join((text, crossing, changes))


SECTION = Section("ablation", "Ablation", _write)


# The output bands: their coverage on the sealed test.


def _write_bands(subject: Subject) -> Html | None:
    opened = subject.view.unsealed
    if opened is None or opened.bands is None:
        return None
    pairs = (
        ("model", opened.bands.model),
        ("nominal coverage", subject.number(opened, "bands.level", "share")),
        ("outside the region of validity", subject.number(opened, "bands.outside", "share")),
    )
    rows = [
        [said(name), subject.number(opened, f"bands.covered.{c}", "share")]
        for c, name in enumerate(opened.channels[: len(opened.bands.covered)])
    ]
    head = ["output", "coverage of the test samples"]
    return join((facts(pairs), table(head, rows, "The bands on the sealed test")))


BANDS = Section("bands", "Output bands", _write_bands)


# The confirmation: significance of the winner over repeated fits.


def _write_confirmation(subject: Subject) -> Html | None:
    found = subject.view.confirmed
    if found is None:
        return None
    text = tag(
        "p",
        "After the search the candidates with the lowest V were refitted on every fold, with ",
        subject.number(found, "seeds", "count"),
        " seeds chosen by the evaluator. If the fits of a candidate do not depend on the seed, "
        "it was refitted once.",
    )
    after = used_no_test(found.after_unsealing)
    return join((text, _candidates(subject, found), _pairs(subject, found),
                 _expected(subject, found), after))  # fmt: skip


def _candidates(subject: Subject, found: Confirmed) -> Html:
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
            subject.interval(found, f"{at}.value", "error"),
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
    rows: list[list[str]] = []
    for k, pair in enumerate(found.pairs):
        at = f"pairs.{k}"
        names = [subject.number(found, f"{at}.{side}", "number") for side in ("first", "second")]
        text = "is better" if pair.apart else "statistically equal"
        gap = subject.interval(found, f"{at}.difference", "signed_error")
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
    noise: tuple[str, ...] = ()
    if found.noise is not None:
        text = "The standard deviation of V over seeds is "
        noise = (text, subject.number(found, "noise", "sig2"), ". ")
    if found.expected is None:
        return tag("p", *noise, "The expected error of the winner is unknown: its repeats failed.")
    ensemble: tuple[str, ...] = ()
    if found.ensemble is not None:
        ensemble = ("; their ensemble one of ", subject.interval(found, "ensemble", "error"))
    return tag(
        "p",
        *noise,
        "On a new record of the same kind, as long as a fold, one of its fold models is expected "
        "to have an error of ",
        subject.interval(found, "expected", "error"),
        ", at a level of ",
        subject.number(found, "expected_level", "share"),
        *ensemble,
        "; of this ",
        subject.number(found, "expected.optimism", "sig2"),
        " corrects for the selection of the best.",
    )


CONFIRMATION = Section("confirmation", "Significance", _write_confirmation)


# The equations and parameters of the winner, fitted to all training records.


def _write_identified(subject: Subject) -> Html | None:
    run, found = subject.run, identified(subject.run)
    if found is None or not (found.equations or found.parameters):
        return None
    parts: list[Html] = []
    if found.equations:
        lines = "\n".join(one_line(line, 600) for line in found.equations)
        title = (
            "The equations of the winner, with the fitted numbers:"
            if found.library
            else "Equations in the candidate's own words, not checked by ASIA:"
        )
        parts.append(tag("p", title))
        parts.append(tag("pre", tag("code", lines), tabindex="0"))
    if found.parameters:
        head = ["parameter", "value", "unit", "standard error", "standard error by folds",
                "interval", "interval decided by", "remark"]  # fmt: skip
        rows = [_parameter(run, found, k) for k in range(len(found.parameters))]
        kept = [k for k in range(len(head)) if k in (0, 1) or any(row[k] for row in rows)]
        head, rows = [head[k] for k in kept], [[row[k] for k in kept] for row in rows]
        own = "" if found.library else ", as the candidate's own code reports them"
        parts.append(table(head, rows, f"Parameters, {found.source}{own}"))
        parts += [tag("p", tag("b", said(line), ".")) for line in interval_lines(found)]
        text = (
            ". It is the widest of three intervals: from the noise, from the spread of the fold "
            "models, and from a missing effect."
        )
        if any(one.interval is not None for one in found.parameters):
            parts.append(tag("p", "Each interval has a level of ", fixed("95 %"), text))
    if found.entangled:
        names = [one.fitted.name for one in found.parameters]
        pairs = [
            [
                join((said(a), " and ", said(b))),
                _number(
                    run, f"correlation.{names.index(a)}.{names.index(b)}", rho, "signed_fixed3"
                ),
            ]
            for a, b, rho in found.entangled[:5]
        ]
        head = ["pair", "correlation of the errors"]
        parts.append(table(head, pairs, "Poorly distinguished by the records"))
    return join(parts)


def _parameter(run: Run, found: IdentifiedModel, number: int) -> list[str | None]:
    one, at = found.parameters[number], f"parameters.{number}"
    fitted = one.fitted
    error = by_folds = None
    if fitted.standard_error is not None:
        error = _number(run, f"{at}.standard_error", fitted.standard_error, "sig2")
    if one.fold_error is not None and not one.is_count:
        by_folds = _of_folds(run, one, [f"{at}.value"], [fitted.value], "jackknife", "sig2")
    return [
        said(fitted.name),
        _number(run, f"{at}.value", fitted.value, "sig5"),
        said(fitted.unit) if fitted.unit else None,
        error,
        by_folds,
        _interval(run, at, one),
        None if one.interval is None else one.decided_by,
        "; ".join(parameter_remarks(found, one)),
    ]


def _interval(run: Run, at: str, one: IdentifiedParameter) -> Html | None:
    fitted = one.fitted
    if one.interval is None or fitted.low is None or fitted.high is None:
        return None
    paths = [f"{at}.{name}" for name in ("value", "low", "high", "lower")]
    values = [fitted.value, fitted.low, fitted.high, fitted.lower]
    ends: list[Html] = []
    for end, value in (("low", fitted.low), ("high", fitted.high)):
        if one.decided_by == "folds":
            ends.append(_of_folds(run, one, paths, values, f"folds_{end}", "sig4"))
        elif one.decided_by == "missing effect":
            sources = _sources(run, [*paths, f"{at}.misfit_error"])
            every = [*values, fitted.misfit_error]
            ends.append(write_number(every, sources, f"effect_{end}", "sig4"))
        else:
            ends.append(_number(run, f"{at}.{end}", value, "sig4"))
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


def _number(run: Run, path: str, value: float, form: str) -> Html:
    return write_number([value], _sources(run, [path]), ONE, form)


IDENTIFIED = Section("identified", "Identified parameters", _write_identified)


# The validation: objections against the use of the model.


_KINDS: Final = {Verdict.PASS: "good", Verdict.DOUBT: "doubt", Verdict.FAIL: "none"}


def _check_pictures(drawn: Sequence[DrawnCheck], further: Html | None = None) -> Html:
    """The curves of checks. further: another picture beside them."""
    parts: list[Html | None] = []
    for one in drawn:
        more = None
        if one.left_out:
            more = tag("p", "Further curves are in report/validation.pdf.")
        names = ", ".join(curve.name for curve in one.curves)
        alt = f"{one.name}: {one.axes[1]} over {one.axes[0]}, of {names}"
        parts.append(tag("div", picture(partial(draw_check, one), alt, PANEL), more))
    return tag("div", *parts, further, class_="grid")


def _write_validation(subject: Subject) -> Html | None:
    found = subject.view.validated
    return join([_validation(subject, one) for one in found]) if found else None


def _validation(subject: Subject, found: Validated) -> Html:
    title = "On the held-out data"
    if found.record:
        title = join(("On the new record ", said(found.record)))
    counts = tag(
        "p",
        "Checks passed: ",
        subject.number(found, "passed", "count"),
        "; in doubt: ",
        subject.number(found, "doubtful", "count"),
        "; failed: ",
        subject.number(found, "failed", "count"),
        ". The checked model is the ",
        found.model,
        " of experiment ",
        subject.number(found, "experiment", "number"),
        ".",
    )
    worst: Html | None = None
    rows: list[Html] = []
    for k, one in enumerate(found.checks):
        sentence = subject.number(found, f"checks.{k}.sentence", "text")
        kind = _KINDS.get(one.verdict, "shown")
        stamp = tag("span", str(one.verdict), class_=f"stamp small {kind}")
        name = tag("th", one.name, scope="row")
        rows.append(tag("tr", name, tag("td", stamp), tag("td", sentence)))
        if one.name == found.worst and worst is None:
            worst = tag("p", tag("b", "Most important: "), sentence, ".", class_="sentence")
    head = [tag("th", text, scope="col") for text in ("check", "verdict", "finding")]
    caption = tag("caption", "Validation checks")
    inner = tag("table", caption, tag("thead", tag("tr", *head)), tag("tbody", *rows))
    label = f"Validation checks, {found.record or 'held-out parts'}"
    checks = region("div", inner, class_="scroll checks", label=label)
    pictures = None
    if subject.run.store.kept:
        drawn = get_curves(subject.run.store, found.curves)
        pictures = _check_pictures(drawn) if drawn else None
    after = used_no_test(found.after_unsealing)
    return join((tag("h3", title), counts, worst, after, checks, pictures))


VALIDATION = Section("validation", "Validation", _write_validation)


# The linear models: what `asia linear` wrote next to the ledger.


LINEAR_FILE: Final = Path("linear", "linear.json")
"""File of `asia linear` in the folder of a run."""
_MOST_BYTES = 4_000_000
_DRAWN: TypeAdapter[tuple[DrawnCheck, ...]] = TypeAdapter(tuple[DrawnCheck, ...])


CONTROL_FILE: Final = Path("control", "control.json")
"""File of `asia control` in the folder of a run."""


def _complex(values: Sequence[Mapping[str, float]]) -> NDArray[np.complex128]:
    return np.array([complex(one["real"], one["imag"]) for one in values], np.complex128)


def command_lines(lines: Sequence[str], label: str, indent: int = 10) -> Html:
    """Text of a command, whose long lines wrap below the end of their first `indent` letters."""
    style = f"padding-left:{indent}ch;text-indent:-{indent}ch"
    code = tag("code", *(tag("span", line or " ", style=style) for line in lines))
    return region("pre", code, label=label, class_="lines")


def _write_command(subject: Subject, file: Path, command: str) -> Html | None:
    """Text and pictures that a command wrote next to the ledger; None without its file."""
    path = subject.run.directory / file
    if not path.exists():
        return None
    remedy = f"run {command} again"
    content = read_file(path, remedy) if path.stat().st_size <= _MOST_BYTES else b""
    try:
        found = json.loads(content)
        lines, drawn = [str(one) for one in found["text"]], _DRAWN.validate_python(found["drawn"])
        planes = [
            (str(one["at"]), _complex(one["poles"]), _complex(one["zeros"]))
            for one in found.get("points", ())
        ]
    except (ValueError, TypeError, LookupError):
        return tag("p", f"{file} is no file of this version: {remedy}.")
    note = tag("p", "Written by ", tag("code", command), ". The ledger does not record it.")
    text = command_lines(lines, f"Output of {command}")
    poles = None
    if planes:
        alt = "Poles and zeros in the z-plane; the text has the poles"
        poles = picture(partial(draw_poles, planes), alt, PANEL)
    return join((note, text, _check_pictures(drawn, poles)))


LINEAR = Section(
    "linear", "Linear models", partial(_write_command, file=LINEAR_FILE, command="asia linear")
)
CONTROL = Section(
    "control", "Control", partial(_write_command, file=CONTROL_FILE, command="asia control")
)


# The certificate: what `asia certify` wrote next to the ledger.


CERTIFICATE_FILE: Final = Path("certificate.json")
"""File of `asia certify` in the folder of a run."""
LOOP_CERTIFICATE_FILE: Final = CONTROL_FILE.with_name("certificate.json")
"""File of `asia certify --loop` there."""


def _write_certificates(subject: Subject) -> Html | None:
    parts = [
        part
        for file, command in (
            (CERTIFICATE_FILE, "asia certify"),
            (LOOP_CERTIFICATE_FILE, "asia certify --loop"),
        )
        if (part := _write_certificate(subject.run.directory / file, command)) is not None
    ]
    return join(parts) if parts else None


def _write_certificate(path: Path, command: str) -> Html | None:
    if not path.exists():
        return None
    remedy = f"run {command} again"
    try:
        content = read_file(path, remedy) if path.stat().st_size <= _MOST_BYTES else b""
        found = json.loads(content)
        rows = [["proven", str(one["text"])] for one in found["statements"]]
        rows += [["open", str(one)] for one in found["missed"]]
        rows += [["assumption", str(one)] for one in found["assumptions"]]
    except (ValueError, TypeError, LookupError):
        return tag("p", f"{path.name} is no file of this version: {remedy}.")
    note = tag(
        "p", "Written by ", tag("code", command), ". The ledger does not record it. ",
        tag("code", "asia certify --check"), " proves it again.",
    )  # fmt: skip
    return join((note, command_lines([f"{a:16}{b}" for a, b in rows], "Certificate", 16)))


CERTIFICATE = Section("certificate", "Certificate", _write_certificates)
