"""Survey of the files of a folder before inputs and outputs are chosen."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from asia.data.intake.formats.table import FORMATS, file_format
from asia.data.intake.numbers import to_numbers
from asia.data.intake.part import labels
from asia.data.intake.sheet import Sheet, Wanted, find_column, require_column, split_unit
from asia.data.intake.stamps import time_column
from asia.errors import UserError

_INPUT = re.compile(r"(u|in|input)[ _.]?\d*")
_OUTPUT = re.compile(r"(y|out|output)[ _.]?\d*")
_MOST_FILES = 50


@dataclass(frozen=True)
class FileColumns:
    """Columns of a file, with a guess at inputs and outputs."""

    names: tuple[str, ...]
    """All but that of the sample times, without their units."""
    time: str | None
    """The column with the sample times."""
    timed: bool
    """Whether the file contains its sampling time."""
    unusable: Mapping[str, str] = field(default_factory=dict[str, str])
    """Columns that cannot be an output, and why."""

    @property
    def inputs(self) -> tuple[str, ...]:
        """Likely inputs by their names; where names give no hint, all but the outputs."""
        return self._named(_INPUT) or tuple(n for n in self._usable if n not in self.outputs)

    @property
    def outputs(self) -> tuple[str, ...]:
        """Likely outputs by their names; where names give no hint, those that are no inputs, or the
        last one."""
        found = self._named(_OUTPUT)
        if not found and self._named(_INPUT):
            found = tuple(n for n in self._usable if n not in self._named(_INPUT))
        return found or self._usable[-1:]

    @property
    def _usable(self) -> tuple[str, ...]:
        return tuple(n for n in self.names if n not in self.unusable)

    def _named(self, pattern: re.Pattern[str]) -> tuple[str, ...]:
        return tuple(n for n in self._usable if pattern.fullmatch(n.casefold()))


def survey(path: Path, wanted: Wanted) -> FileColumns:
    """The columns of a file with records. Raises UserError."""
    fmt = file_format(path)
    sheets = fmt.read(path, wanted)
    if any(not len(c.cells) for s in sheets for c in s.columns.values()):
        # Some formats read only the columns that are asked for.
        every = tuple(dict.fromkeys(n for s in sheets for n in s.columns))
        sheets = fmt.read(path, replace(wanted, inputs=every, outputs=()))
    whole = Sheet(path.stem, {n: c for s in sheets for n, c in s.columns.items()}, where=str(path))
    time = time_column(whole, wanted)
    experiment = wanted.experiment and find_column(list(whole.columns), wanted.experiment)
    left = [n for n in whole.columns if n and n not in (time, experiment)]
    if len(left) < 2:
        raise UserError(
            f"{path} has {len(left)} columns beside the time: an input and an output are needed"
        )
    timed = time is not None or any(
        s.sampling_time is not None or any(c.seconds is not None for c in s.columns.values())
        for s in sheets
    )
    reasons = {split_unit(n)[0]: _why_unusable(n, sheets) for n in left}
    unusable = {name: reason for name, reason in reasons.items() if reason}
    return FileColumns(tuple(split_unit(n)[0] for n in left), time, timed, unusable)


def _why_unusable(name: str, sheets: Sequence[Sheet]) -> str:
    """Return the reason why a column cannot be an output; "" where it can."""
    columns = [s.columns[name] for s in sheets if name in s.columns]
    try:
        values = np.concatenate([to_numbers(c.cells, name, 1) for c in columns])
    except UserError:
        return "holds no numbers"
    values = values[np.isfinite(values)]
    if not values.size:
        return "holds no values"
    return f"is {values[0]:g} in every sample" if (values == values[0]).all() else ""


def experiments_in(paths: Sequence[Path], wanted: Wanted) -> tuple[str, ...]:
    """Names of the experiments in files, where one file has several. Raises UserError."""
    found: list[str] = []
    for path in paths:
        sheets = file_format(path).read(path, wanted)
        if wanted.experiment is None:
            found += [s.name for s in sheets] if len(sheets) > 1 else []
            continue
        for sheet in sheets:
            found += labels(require_column(sheet, wanted.experiment))
    return tuple(dict.fromkeys(found))


def record_files(folder: Path) -> tuple[list[Path], list[Path]]:
    """Files in a folder that may hold records, in the order of their names: for training, and those
    whose names say that they are for a test. Empty where there are too many to be meant."""
    suffixes = {s for fmt in FORMATS for s in fmt.suffixes if s != "/"}
    found = sorted(p for p in folder.iterdir() if p.is_file() and p.suffix.lower() in suffixes)
    if len(found) > _MOST_FILES:
        return [], []
    tests = [p for p in found if "test" in p.stem.casefold()]
    return [p for p in found if p not in tests], tests


def split_names(text: str, known: Sequence[str] = ()) -> list[str]:
    """Split an answer into names of columns or files: a known name, or several between commas, or
    else between blanks."""
    if text.strip() in known:
        return [text.strip()]
    parts = text.split(",") if "," in text else text.split()
    return [part.strip() for part in parts if part.strip()]
