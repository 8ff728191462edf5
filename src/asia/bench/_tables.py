"""Tables for people: aligned Markdown that reads as well on a terminal."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from dataclasses import dataclass

from asia._text import printable_line
from asia.bench._paper import Paper
from asia.bench._rows import Comparison, Reached, Row
from asia.ledger import error_value
from asia.protocol import EarlyStopping, ShownResidual

_TITLES: dict[EarlyStopping, str] = {
    "inner": "V with inner early stopping: nothing of the held-out fold is seen in training",
    "validation": "V with validation early stopping, as in the paper: training asks for its score "
    "on the held-out fold, so V is not leak-free",
}
_SHOWN: dict[ShownResidual, str] = {
    "train": "",
    "held_out": "; agents saw residuals of the held-out folds",
}
_NOTHING = "-"


@dataclass(frozen=True)
class TextTable:
    """Cells as text; the first column is left-aligned, the others right."""

    title: str
    """Heading above it."""
    header: tuple[str, ...]
    """Heads of the columns."""
    rows: tuple[tuple[str, ...], ...]
    """Cells, as many in each row as there are heads."""
    notes: tuple[str, ...] = ()
    """Sentences below it."""

    def markdown(self) -> str:
        """Title, rows and notes."""
        cells = [tuple(map(_cell, row)) for row in (self.header, *self.rows)]
        widths = [max(3, *(len(row[i]) for row in cells)) for i in range(len(self.header))]
        rule = ["-" * widths[0], *("-" * (w - 1) + ":" for w in widths[1:])]
        lines = [_line(row, widths) for row in (cells[0], rule, *cells[1:])]
        notes = [f"\n{note}" for note in self.notes]
        return "\n".join([f"## {self.title}", "", *lines, *notes]) + "\n"


def _cell(text: str) -> str:
    """Names of arms and signals neither end a row nor make a column."""
    return printable_line(text).replace("|", "\\|")


def _line(cells: Sequence[str], widths: Sequence[int]) -> str:
    first = cells[0].ljust(widths[0])
    rest = [c.rjust(w) for c, w in zip(cells[1:], widths[1:], strict=True)]
    return f"| {' | '.join([first, *rest])} |"


def comparison_table(comparison: Comparison, paper: Paper | None) -> TextTable:
    """Write V of every row. The paper's column is only in the table of its own setting."""
    validation = comparison.setting == "validation"
    header = ("model", "V", "lowest", "highest", "runs")
    rows = [_cells(row) for row in comparison.rows]
    if validation:
        header = (*header, "scores seen")
        rows = [
            (*c, str(r.scores_seen) if r.runs else _NOTHING)
            for c, r in zip(rows, comparison.rows, strict=True)
        ]
    if validation and paper is not None:
        header = (*header, "V paper")
        rows = [(*c, _number(r.paper)) for c, r in zip(rows, comparison.rows, strict=True)]
    notes = [_reached_note(r) for r in comparison.reached]
    if any(row.runs > 1 for row in comparison.rows):
        notes.insert(0, "V is the median over the runs, one a seed.")
    if validation:
        notes.append("Scores seen: number of held-out scores that the fits of one V received.")
    elif paper is not None:
        notes.append(_not_comparable(paper))
    return TextTable(
        _TITLES[comparison.setting] + _SHOWN[comparison.residuals],
        header,
        tuple(rows),
        tuple(notes),
    )


def _cells(row: Row) -> tuple[str, ...]:
    if row.runs == 0:
        return (row.model, _NOTHING, _NOTHING, _NOTHING, _NOTHING)
    low, high = min(row.values, default=None), max(row.values, default=None)
    scored = len(row.values)
    runs = str(row.runs) if scored == row.runs else f"{scored} of {row.runs} scored"
    return (row.model, _number(row.median), _number(low), _number(high), runs)


def _number(value: float | None) -> str:
    return _NOTHING if value is None else error_value(value)


def _reached_note(reached: Reached) -> str:
    each = ", ".join(
        f"seed {seed}: {'not reached' if count is None else count}"
        for seed, count in zip(reached.seeds, reached.experiments, strict=True)
    )
    counts = [c for c in reached.experiments if c is not None]
    middle = f"; median {statistics.median(counts):g}" if len(counts) > 1 else ""
    return (
        f"Experiments the {reached.arm} needed to reach the best V of {reached.control}: "
        f"{each}{middle}"
    )


def _not_comparable(paper: Paper) -> str:
    values = ", ".join(f"{v.model} {v.value:.3f}" for v in paper.values)
    return f"Not comparable, measured with validation early stopping in the paper: {values}."
