"""Sections of the report: what `asia control` and `asia certify` wrote next to the ledger, and the
closed loop of the best candidate of a control problem."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from asia._files import read_file
from asia.errors import UserError
from asia.judge.evaluation.references import CONTROLLERS
from asia.presentation.table import FORMATS
from asia.problem.metrics import find_metric
from asia.report.page.sections.evidence import MOST_BYTES, command_section
from asia.report.page.sections.verdict import draw_held_out
from asia.report.page.subject import Cost, Section, Subject

_TEMPLATES = Path(__file__).parent / "templates"
CONTROL_FILE: Final = Path("control", "control.json")
"""File of `asia control` in the folder of a run."""
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
        content = read_file(path, remedy) if path.stat().st_size <= MOST_BYTES else b""
        found = json.loads(content)
        rows = [["proven", str(one["text"])] for one in found["statements"]]
        rows += [["open", str(one)] for one in found["missed"]]
        rows += [["assumption", str(one)] for one in found["assumptions"]]
    except (ValueError, TypeError, LookupError):
        return f"{path.name} is no file of this version: {remedy}.", []
    return "", [f"{kind:16}{text}" for kind, text in rows]


def _costs(
    subject: Subject, files: str, values_of: Callable[[dict[str, Any]], list[float]]
) -> dict[int, float]:
    """Largest value in the files of a command by experiment. Files of other versions are left
    out."""
    found: dict[int, float] = {}
    best = subject.view.best
    for path in sorted(subject.run.directory.glob(files)):
        try:
            content = json.loads(read_file(path, "run the command again"))
            model, values = str(content["model"]).removeprefix("experiment "), values_of(content)
        except (ValueError, TypeError, LookupError, UserError):
            continue
        # The refit and the ensemble are the best experiment's; a stack is of several.
        number = 0 if best is None or model == "stack" else best.number
        number = int(model) if model.isdecimal() else number
        if number and values and math.isfinite(max(values)):
            found[number] = max(values)
    return found


def _gains(subject: Subject) -> dict[int, float]:
    return _costs(
        subject, "certificate*.json",
        lambda c: [float(s["bound"]) for s in c["statements"] if s["kind"] == "H-infinity norm"],
    )  # fmt: skip


def _iae(subject: Subject) -> dict[int, float]:
    return _costs(
        subject, "control*/control.json", lambda c: [float(one["iae"]) for one in c["responses"]]
    )


CONTROL = command_section(
    "control", "Control", CONTROL_FILE, "asia control", after="linear",
    cost=Cost("cost of the closed loop (IAE)", _iae),
)  # fmt: skip
CERTIFICATE = Section(
    "certificate", "Certificate", _certificates, "certificate.html", folder=_TEMPLATES,
    after="control", files=(CERTIFICATE_FILE, LOOP_CERTIFICATE_FILE),
    cost=Cost("proven bound of the gain", _gains),
)  # fmt: skip


# The closed loop of a control problem.


def _closed_loop(subject: Subject) -> dict[str, Any] | None:
    best, problem = subject.view.best, subject.problem
    if best is None or best.score is None or problem is None or problem.control is None:
        return None
    score, error, sig = best.score, FORMATS["error"], FORMATS["sig"]
    rows = [[best.proposed.title, subject.v(best), ""]]
    for name in CONTROLLERS:
        value = subject.reference(name)
        if value is not None:
            rows.append([name, error(value), FORMATS["times"](value / score.value)])
    metric = find_metric(problem.protocol.metric)
    head = ["fold", "V", *(f"{metric.label} {s.label}" for s in problem.outputs)]
    each = [
        [
            f"{k + 1}: {subject.view.started.folds[k]}",
            error(fold.value),
            *(sig(fold.per_channel(metric.name)[c]) for c in range(len(problem.outputs))),
        ]
        for k, fold in enumerate(score.folds)
    ]
    return {"costs": rows, "head": head, "folds": each, "drawn": draw_held_out(subject, best)}


LOOP = Section(
    "loop", "Closed loop", _closed_loop, "loop.html", folder=_TEMPLATES, after="accuracy"
)
