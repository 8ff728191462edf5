"""Curves of the validation checks, as an artifact of a run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pydantic import TypeAdapter, ValidationError

from asia.data import Array
from asia.errors import UserError
from asia.ledger._store import Store
from asia.scoring.dossier import Check, CheckCurve

MOST_CURVES = 5
"""Maximum number of curves of a check: more cannot be distinguished in a drawing."""
_COLUMNS = 120
_DIGITS = 5


@dataclass(frozen=True)
class DrawnCurve:
    """One line to draw."""

    name: str
    """Name of the curve."""
    x: tuple[float, ...]
    """(n,)."""
    y: tuple[float, ...]
    """(n,)."""
    band: float | None = None
    """Half the width of a band around zero that chance stays within; None without one."""


@dataclass(frozen=True)
class DrawnCheck:
    """Drawing of one check."""

    name: str
    """Name of the check."""
    axes: tuple[str, str]
    """Names of the axes."""
    curves: tuple[DrawnCurve, ...]
    """Curves, at least one."""
    left_out: int = 0
    """Curves beyond those."""


_DRAWN: TypeAdapter[tuple[DrawnCheck, ...]] = TypeAdapter(tuple[DrawnCheck, ...])


def put_curves(store: Store, checks: Sequence[Check]) -> str:
    """Keep the first curves of each check, with less points where they have many; the name of the
    artifact."""
    drawn = tuple(
        DrawnCheck(
            one.name,
            one.axes,
            tuple(_drawn(curve) for curve in one.curves[:MOST_CURVES]),
            max(0, len(one.curves) - MOST_CURVES),
        )
        for one in checks
        if one.curves
    )
    return store.put(_DRAWN.dump_json(drawn))


def get_curves(store: Store, name: str) -> tuple[DrawnCheck, ...]:
    """Those of an artifact. Raises UserError where it is missing or this version cannot read it."""
    try:
        return _DRAWN.validate_json(store.get(name))
    except ValidationError:
        raise UserError(
            f"artifact {name} was written by another version of ASIA: read it with that one"
        ) from None


def _drawn(curve: CheckCurve) -> DrawnCurve:
    whole = np.isfinite(curve.x) & np.isfinite(curve.y)
    x, y = curve.x[whole], curve.y[whole]
    kept = _extremes(y)
    return DrawnCurve(curve.name, _rounded(x[kept]), _rounded(y[kept]), curve.band)


def _extremes(y: Array) -> list[int]:
    """Return the indices of the minimum and maximum of each segment; all indices of a short
    curve.
    """
    if len(y) <= 2 * _COLUMNS:
        return list(range(len(y)))
    found: set[int] = set()
    for part in np.array_split(np.arange(len(y)), _COLUMNS):
        found |= {int(part[np.argmin(y[part])]), int(part[np.argmax(y[part])])}
    return sorted(found)


def _rounded(values: Array) -> tuple[float, ...]:
    return tuple(float(f"{value:.{_DIGITS}g}") for value in values.tolist())
