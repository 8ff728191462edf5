"""A record as the text of a CSV file."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

from asia.data import Trajectory

_BLOCK = 65_536


@dataclass(frozen=True)
class RecordRows:
    """The text of a record that is too long to be held as a whole."""

    record: Trajectory
    """The record."""
    names: Sequence[str]
    """Names of inputs and outputs."""
    progress: Callable[[str], None] = field(default=lambda text: None, compare=False)
    """Callback for the progress of a long write, in words."""

    def blocks(self) -> Iterator[str]:
        """A header row with the names, then a row a sample. It reads back as the same numbers; an
        output that was not measured is `nan`."""
        header = io.StringIO()
        csv.writer(header, lineterminator="\n").writerow(self.names)
        yield header.getvalue()
        u, y = self.record.u, self.record.measured_y
        for first in range(0, len(u), _BLOCK):
            part = slice(first, first + _BLOCK)
            if first:
                self.progress(f"writing {self.record.name}: {first / len(u):.0%} of {len(u)} rows")
            rows = zip(u[part].tolist(), y[part].tolist(), strict=True)
            # repr gives the shortest text that reads back as the same number.
            yield "".join(",".join(map(repr, [*a, *b])) + "\n" for a, b in rows)


def record_csv(record: Trajectory, names: Sequence[str]) -> str:
    """The whole text of `RecordRows`."""
    return "".join(RecordRows(record, names).blocks())
