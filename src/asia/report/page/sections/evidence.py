"""Sections of evidence: parameters, bands, confirmation, ablation, validation."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray
from pydantic import TypeAdapter

from asia._files import read_file
from asia._text import one_line
from asia.judge.scoring.checks.check import Verdict
from asia.ledger.evidence import (
    DrawnCheck,
    IdentifiedModel,
    IdentifiedParameter,
    get_curves,
    identified,
)
from asia.presentation.parameters import interval_lines, parameter_remarks
from asia.presentation.table import FORMATS
from asia.report.drawing.inline import PANEL
from asia.report.page.render import picture
from asia.report.page.subject import Section, Subject
from asia.report.pictures.analysis import draw_poles
from asia.report.pictures.evidence import draw_check

# The ablation: contributions of the changes to the gain of the best candidate.


_PARTS = (
    ("its model, with the training of the baseline", "model"),
    ("its training, with the model of the baseline", "training"),
    ("interaction of both", "interaction"),
    ("in all", "gain"),
)


def _ablation(subject: Subject) -> dict[str, Any] | None:
    found = subject.view.ablated
    if found is None:
        return None
    interval, crossing = FORMATS["interval"], found.crossing
    parts = [
        [text, interval(getattr(crossing, name), "signed_error")] for text, name in _PARTS
    ] if crossing is not None else []  # fmt: skip
    changes = [
        [
            f"#{one.experiment:02d}",
            one.detail if one.loss is None else interval(one.loss, "signed_error"),
        ]
        for one in found.left_out
    ]
    return {"found": found, "parts": parts, "changes": changes}


SECTION = Section("ablation", "Ablation", _ablation)


# The output bands: their coverage on the sealed test.


def _bands(subject: Subject) -> dict[str, Any] | None:
    opened = subject.view.unsealed
    if opened is None or opened.bands is None:
        return None
    rows = [
        [name, FORMATS["share"](covered)]
        for name, covered in zip(opened.channels, opened.bands.covered, strict=False)
    ]
    return {"bands": opened.bands, "rows": rows}


BANDS = Section("bands", "Output bands", _bands)


# The confirmation: significance of the best candidate over repeated fits.


def _confirmation(subject: Subject) -> dict[str, Any] | None:
    found = subject.view.confirmed
    if found is None:
        return None
    rows = [
        [
            f"#{one.experiment:02d}",
            f"{one.best_rank}"
            if one.worst_rank == one.best_rank
            else f"{one.best_rank} to {one.worst_rank}",
            FORMATS["interval"](one.value, "error"),
            FORMATS["error"](one.first),
            "fits do not depend on the seed"
            if one.deterministic
            else "" if one.spread is None else FORMATS["sig"](one.spread, 2),
            f"{one.failed}",
        ]
        for one in found.candidates
    ]  # fmt: skip
    pairs = [
        [
            f"#{pair.first:02d} and #{pair.second:02d}",
            FORMATS["interval"](pair.difference, "signed_error"),
            "is better" if pair.apart else "statistically equal",
        ]
        for pair in found.pairs
    ]
    return {"found": found, "rows": rows, "pairs": pairs}


CONFIRMATION = Section("confirmation", "Significance", _confirmation)


# The equations and parameters of the best candidate, fitted to all training records.


def _identified(subject: Subject) -> dict[str, Any] | None:
    found = identified(subject.run)
    if found is None or not (found.equations or found.parameters):
        return None
    head = ["parameter", "value", "unit", "standard error", "standard error by folds",
            "interval", "interval decided by", "remark"]  # fmt: skip
    rows = [_parameter(found, one) for one in found.parameters]
    kept = [k for k in range(len(head)) if k in (0, 1) or any(row[k] for row in rows)]
    own = "" if found.library else ", as the candidate's own code reports them"
    pairs = [[f"{a} and {b}", FORMATS["signed"](rho)] for a, b, rho in found.entangled[:5]]
    return {
        "found": found,
        "equations_text": "\n".join(one_line(line, 600) for line in found.equations),
        "head": [head[k] for k in kept],
        "rows": [[row[k] for k in kept] for row in rows],
        "caption": f"Parameters, {found.source}{own}",
        "interval_lines": interval_lines(found),
        "has_intervals": any(one.interval is not None for one in found.parameters),
        "pairs": pairs,
    }


def _parameter(found: IdentifiedModel, one: IdentifiedParameter) -> list[str]:
    fitted, sig = one.fitted, FORMATS["sig"]
    by_folds = "" if one.fold_error is None or one.is_count else sig(one.fold_error, 2)
    return [
        one_line(fitted.name),
        sig(fitted.value, 5),
        one_line(fitted.unit),
        "" if fitted.standard_error is None else sig(fitted.standard_error, 2),
        by_folds,
        "" if one.interval is None else " to ".join(map(sig, one.interval)),
        "" if one.interval is None else one.decided_by,
        "; ".join(parameter_remarks(found, one)),
    ]


IDENTIFIED = Section("identified", "Identified parameters", _identified)


# The validation: objections against the use of the model.


_KINDS: Final = {Verdict.PASS: "good", Verdict.DOUBT: "doubt", Verdict.FAIL: "none"}


def _validation(subject: Subject) -> dict[str, Any] | None:
    found, store = subject.view.validated, subject.run.store
    if not found:
        return None
    reports = [
        {
            "found": one,
            "checks": [(check, _KINDS.get(check.verdict, "shown")) for check in one.checks],
            "worst": next((c.sentence for c in one.checks if c.name == one.worst), None),
            "drawn": _check_pictures(get_curves(store, one.curves)) if store.kept else [],
        }
        for one in found
    ]
    return {"reports": reports}


def _check_pictures(drawn: Sequence[DrawnCheck]) -> list[tuple[Markup, int]]:
    """The curves of checks, and how many of each are left out."""
    found: list[tuple[Markup, int]] = []
    for one in drawn:
        names = ", ".join(curve.name for curve in one.curves)
        alt = f"{one.name}: {one.axes[1]} over {one.axes[0]}, of {names}"
        found.append((picture(partial(draw_check, one), alt, PANEL), one.left_out))
    return found


VALIDATION = Section("validation", "Validation", _validation)


# The linear models: what `asia linear` wrote next to the ledger.


LINEAR_FILE: Final = Path("linear", "linear.json")
"""File of `asia linear` in the folder of a run."""
MOST_BYTES: Final = 4_000_000
"""Most bytes of a file that a section reads."""
_DRAWN: TypeAdapter[tuple[DrawnCheck, ...]] = TypeAdapter(tuple[DrawnCheck, ...])


def _complex(values: Sequence[Mapping[str, float]]) -> NDArray[np.complex128]:
    return np.array([complex(one["real"], one["imag"]) for one in values], np.complex128)


def _command(subject: Subject, file: Path, command: str) -> dict[str, Any] | None:
    """Text and pictures that a command wrote next to the ledger; None without its file."""
    path = subject.run.directory / file
    if not path.exists():
        return None
    remedy = f"run {command} again"
    content = read_file(path, remedy) if path.stat().st_size <= MOST_BYTES else b""
    try:
        found = json.loads(content)
        lines, drawn = [str(one) for one in found["text"]], _DRAWN.validate_python(found["drawn"])
        planes = [
            (str(one["at"]), _complex(one["poles"]), _complex(one["zeros"]))
            for one in found.get("points", ())
        ]
    except (ValueError, TypeError, LookupError):
        return {"command": command, "refused": f"{file} is no file of this version: {remedy}."}
    shown = _check_pictures(drawn)
    if planes:
        alt = "Poles and zeros in the z-plane; the text has the poles"
        shown.append((picture(partial(draw_poles, planes), alt, PANEL), 0))
    return {"command": command, "refused": None, "lines": lines, "drawn": shown}


def command_section(key: str, title: str, file: Path, command: str, **options: Any) -> Section:
    """Make the section of a command from the text and the pictures in its file.

    Args:
        file: path in the folder of a run
        options: other fields of the section
    """
    content = partial(_command, file=file, command=command)
    return Section(key, title, content, "command.html", files=(file,), **options)


LINEAR = command_section("linear", "Linear models", LINEAR_FILE, "asia linear")
