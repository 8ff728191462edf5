"""Tables, sentences and numbers of a result, made once for the terminal, a page and LaTeX."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

from asia._text import one_line
from asia._timer import duration
from asia.judge.scoring.repeated_fits import Interval

# Numbers.


def error_value(value: float, decimals: int = 4) -> str:
    """Four decimals, or as many as asked for; powers of ten where a simulation ran away."""
    return f"{value:.{decimals}f}" if value < 1e4 else f"{value:.2e}"


MOST_DECIMALS = 7


def error_decimals(values: Iterable[float], thresholds: Iterable[float | None] = ()) -> int:
    """Return the least number of decimals, from 4 on, with which different errors read differently;
    at most one more than the least threshold of significance has, else `MOST_DECIMALS`."""
    known = [one for one in thresholds if one]
    most = MOST_DECIMALS if not known else math.floor(1 - math.log10(min(known)))
    most = min(max(most, 4), MOST_DECIMALS)
    different = set(values)
    for decimals in range(4, most):
        if len({error_value(value, decimals) for value in different}) == len(different):
            return decimals
    return most


def _signed_error(value: float) -> str:
    return f"{value:+.4f}" if 5e-5 <= abs(value) < 1e4 or value == 0 else f"{value:+.1e}"


def _interval(found: Interval, form: str) -> str:
    value, low, high = (FORMATS[form](v) for v in (found.value, found.low, found.high))
    return value if found.low == found.high else f"{value} ({low} to {high})"


FORMATS: Final[dict[str, Callable[..., str]]] = {
    "error": error_value,
    "sig": lambda v, digits=4: f"{v:.{digits}g}",
    "signed": lambda v: f"{v:+.3f}",
    "fixed": lambda v: f"{v:.2f}",
    "percent": lambda v: f"{v:.1f} %",
    "share": lambda v: f"{100 * v:.1f} %",
    "signed_share": lambda v: f"{100 * v:+.1f} %",
    "signed_error": _signed_error,
    "times": lambda v: f"{v:.2g}" if v < 100 else f"{v:.0f}",
    "number": lambda v: f"#{v:02d}",
    "duration": duration,
    "dollars": lambda v: f"{v:.4f} USD",
    "interval": _interval,
    "line": one_line,
}
"""Format of each kind of value, from a value to a text; filters of page templates too."""


# Tables and listings, which with plain sentences make up what is shown of a result.


@dataclass(frozen=True)
class Table:
    """Table of a result."""

    caption: str
    columns: Mapping[str, str]
    """Title of each column with the format of its values: a name in `FORMATS`, with its argument
    behind a colon, or "" for text."""
    rows: Sequence[Sequence[Any]]
    """Values of each row. None is an empty cell; a text stands for a value that there is not."""

    @cached_property
    def _shown(self) -> list[tuple[str, bool, list[str]]]:
        """Title, whether it holds text, and cells of each column that is not empty."""
        each = zip(*self.rows, strict=True) if self.rows else ((),) * len(self.columns)
        columns = [
            (title, not form, [_cell(value, form) for value in values])
            for (title, form), values in zip(self.columns.items(), each, strict=True)
        ]
        return [one for one in columns if any(one[2]) or not self.rows]

    @property
    def head(self) -> list[str]:
        """Titles of the columns that are not empty."""
        return [one_line(title) for title, _, _ in self._shown]

    @property
    def is_text(self) -> list[bool]:
        """Whether each of these columns holds text, which is aligned to the left."""
        return [text for _, text, _ in self._shown]

    @property
    def cells(self) -> list[list[str]]:
        """Texts of the rows in these columns."""
        return [list(row) for row in zip(*(cells for _, _, cells in self._shown), strict=True)]

    def lines(self) -> Iterator[str]:
        """Yield the table for a terminal: caption, titles, and a line for each row."""
        yield f"{self.caption}:"
        padded: list[list[str]] = []
        for title, text, cells in self._shown:
            column = [one_line(title), *cells]
            width = max(map(len, column))
            padded.append([one.ljust(width) if text else one.rjust(width) for one in column])
        yield from (f"  {'  '.join(row).rstrip()}" for row in zip(*padded, strict=True))


def _cell(value: Any, form: str) -> str:
    if value is None:
        return ""
    name, _, argument = form.partition(":")
    if isinstance(value, str) or not name:
        return one_line(str(value))
    given = [int(argument) if argument.isdecimal() else argument] if argument else []
    return FORMATS[name](value, *given)


@dataclass(frozen=True)
class Listing:
    """Lines of text below a title."""

    title: str
    lines: Sequence[str]


Block = str | Table | Listing
"""Part of what is shown of a result; a plain text is a sentence."""


def block_lines(blocks: Iterable[Block]) -> Iterator[str]:
    """Yield blocks as lines for a terminal."""
    for one in blocks:
        if isinstance(one, Table):
            yield from one.lines()
        elif isinstance(one, Listing):
            yield f"{one.title}:"
            yield from (f"  {line}" for line in one.lines)
        else:
            yield one
