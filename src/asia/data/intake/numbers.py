"""Cells as numbers, the way people and instruments write them."""

from __future__ import annotations

from decimal import Decimal
from math import isinf, nan

import numpy as np

from asia.data._trajectory import Array
from asia.data.intake.sheet import Cells
from asia.errors import UserError

_MISSING = frozenset(
    ("", "nan", "na", "n/a", "n.a.", "#n/a", "#nv", "null", "none", "nil", "-", "--", "---", "?")
) | frozenset(
    # Texts of plant historians in place of a missing value.
    (".", "bad", "bad input", "bad data", "no data", "nodata", "i/o timeout", "comm fail",
     "out of service", "scan off", "pt created", "shutdown", "configure", "error", "invalid")
)  # fmt: skip
_MINUS = str.maketrans({"−": "-", "\u00a0": None, "\u202f": None, "'": None})


def to_numbers(cells: Cells, where: str, first_line: int) -> Array:
    """float64 with NaN where a value is missing.

    Args:
        where: file and column, for messages

    Raises:
        UserError: for a text that is no number, and for an infinite value
    """
    if cells.dtype.kind in "fiub":
        numbers = cells.astype(np.float64)
    elif cells.dtype.kind in "Mmc":
        raise UserError(f"{where} holds dates or complex numbers, expected real numbers")
    else:
        numbers = _parse(cells, where, first_line)
    bad = np.flatnonzero(np.isinf(numbers))
    if bad.size:
        raise UserError(
            f"{where}, line {first_line + int(bad[0])}: the value is infinite: leave the cell "
            "empty where nothing was measured"
        )
    return numbers


def _parse(cells: Cells, where: str, first_line: int) -> Array:
    try:
        return cells.astype(np.float64)
    except (TypeError, ValueError):
        pass
    numbers = np.empty(len(cells))
    for k, cell in enumerate(cells):
        value = number(cell)
        if value is None:
            raise UserError(
                f"{where}, line {first_line + k}: '{cell}' is not a number: correct the cell, or "
                "leave it empty where nothing was measured"
            )
        numbers[k] = value
    return numbers


def number(cell: object) -> float | None:
    """One cell: NaN where it is missing, None where it is no number. A decimal comma, separators of
    thousands and Fortran's D are understood."""
    if cell is None:
        return nan
    if isinstance(cell, bool | int | float | np.number | Decimal):
        return float(cell)
    if not isinstance(cell, str):
        return None
    text = cell.strip().translate(_MINUS)
    if text.casefold() in _MISSING:
        return nan
    comma, point = text.rfind(","), text.rfind(".")
    if comma >= 0 and point >= 0:
        text = text.replace("," if point > comma else ".", "")
    text = text.replace(",", ".")
    if text.count(".") > 1 or "_" in text:
        return None
    try:
        return float(text)
    except ValueError:
        pass
    try:
        value = float(text.replace("d", "e").replace("D", "e"))
    except ValueError:
        return None
    return None if isinf(value) else value
