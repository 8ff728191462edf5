"""A record as the text of a CSV file."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence

from asia.data import Trajectory


def record_csv(record: Trajectory, names: Sequence[str]) -> str:
    """A header row with the names of inputs and outputs, then a row a sample. It reads back as the
    same numbers; an output that was not measured is `nan`."""
    header = io.StringIO()
    csv.writer(header, lineterminator="\n").writerow(names)
    rows = zip(record.u.tolist(), record.measured_y.tolist(), strict=True)
    # repr gives the shortest text that reads back as the same number.
    return header.getvalue() + "".join(",".join(map(repr, [*u, *y])) + "\n" for u, y in rows)
