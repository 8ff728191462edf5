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
from asia.presentation.results import ablation_blocks, confirmation_blocks, validation_blocks
from asia.presentation.table import Block
from asia.report.drawing.inline import PANEL
from asia.report.page.render import picture, show
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
            "blocks": show(validation_blocks(one)),
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
