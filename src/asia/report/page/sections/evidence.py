"""Sections of evidence: parameters, confirmation, ablation, validation."""

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
from asia.judge.scoring.checks.check import Verdict
from asia.ledger.evidence import DrawnCheck, get_curves, identified
from asia.presentation.parameters import identified_blocks
from asia.presentation.results import ablation_blocks, confirmation_blocks
from asia.presentation.table import Block
from asia.report.drawing.inline import PANEL
from asia.report.page.render import picture
from asia.report.page.subject import Section, Subject
from asia.report.pictures.analysis import draw_poles
from asia.report.pictures.evidence import draw_check

# The ablation, the output bands and the repeated fits.


def _ablation(subject: Subject) -> list[Block] | None:
    found = subject.view.ablated
    return found and [*ablation_blocks(found, subject.view.v_name)]


SECTION = Section("ablation", "Ablation", _ablation)


def _confirmation(subject: Subject) -> list[Block] | None:
    found = subject.view.confirmed
    return found and [*confirmation_blocks(found, subject.view.v_name)]


CONFIRMATION = Section("confirmation", "Significance", _confirmation)


# The equations and parameters of the best candidate, fitted to all training records.


def _identified(subject: Subject) -> list[Block] | None:
    found = identified(subject.run)
    return None if found is None else [*identified_blocks(found)] or None


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
_MOST_BYTES = 4_000_000
_DRAWN: TypeAdapter[tuple[DrawnCheck, ...]] = TypeAdapter(tuple[DrawnCheck, ...])


CONTROL_FILE: Final = Path("control", "control.json")
"""File of `asia control` in the folder of a run."""


def _complex(values: Sequence[Mapping[str, float]]) -> NDArray[np.complex128]:
    return np.array([complex(one["real"], one["imag"]) for one in values], np.complex128)


def _command(subject: Subject, file: Path, command: str) -> dict[str, Any] | None:
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
        return {"command": command, "refused": f"{file} is no file of this version: {remedy}."}
    shown = _check_pictures(drawn)
    if planes:
        alt = "Poles and zeros in the z-plane; the text has the poles"
        shown.append((picture(partial(draw_poles, planes), alt, PANEL), 0))
    return {"command": command, "refused": None, "lines": lines, "drawn": shown}


LINEAR = Section(
    "linear", "Linear models", partial(_command, file=LINEAR_FILE, command="asia linear")
)
CONTROL = Section(
    "control", "Control", partial(_command, file=CONTROL_FILE, command="asia control")
)


# The certificate: what `asia certify` wrote next to the ledger.


CERTIFICATE_FILE: Final = Path("certificate.json")
"""File of `asia certify` in the folder of a run."""
LOOP_CERTIFICATE_FILE: Final = CONTROL_FILE.with_name("certificate.json")
"""File of `asia certify --loop` there."""


def _certificates(subject: Subject) -> dict[str, Any] | None:
    folder = subject.run.directory
    found = [
        (command, *_certificate(folder / file, command))
        for file, command in (
            (CERTIFICATE_FILE, "asia certify"),
            (LOOP_CERTIFICATE_FILE, "asia certify --loop"),
        )
        if (folder / file).exists()
    ]
    return {"certificates": found} if found else None


def _certificate(path: Path, command: str) -> tuple[str, list[str]]:
    """Return why a file cannot be shown, else its lines."""
    remedy = f"run {command} again"
    try:
        content = read_file(path, remedy) if path.stat().st_size <= _MOST_BYTES else b""
        found = json.loads(content)
        rows = [["proven", str(one["text"])] for one in found["statements"]]
        rows += [["open", str(one)] for one in found["missed"]]
        rows += [["assumption", str(one)] for one in found["assumptions"]]
    except (ValueError, TypeError, LookupError):
        return f"{path.name} is no file of this version: {remedy}.", []
    return "", [f"{kind:16}{text}" for kind, text in rows]


CERTIFICATE = Section("certificate", "Certificate", _certificates)
