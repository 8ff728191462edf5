"""Records from files, and a survey of the channels that files hold."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np

from asia._text import suggestion
from asia.data.intake.formats import FORMATS, file_format
from asia.data.intake.sheet import (
    FileTable,
    Missing,
    Wanted,
    find_channels,
    find_column,
    require_column,
    split_unit,
)
from asia.data.intake.text import to_numbers
from asia.data.intake.time import (
    JITTER,
    Clock,
    Rows,
    between,
    clock,
    held,
    places,
    runs,
    segments,
)
from asia.data.intake.timestamps import check_time_unit, read_times, time_column
from asia.data.trajectory import Array, Trajectory, unique_names
from asia.errors import UserError

NOT_MEASURED = "output values were not measured"
"""Part of the note on missing outputs of a file."""

# The wanted channels of a sheet as numbers, one part an experiment.


@dataclass(frozen=True)
class TablePart:
    """u (T, nu) and y (T, ny), NaN where a value is missing; stamps (T,) in s, None without."""

    name: str
    u: Array
    y: Array
    timestamps: Array | None
    sampling_time: float | None
    where: str
    first_line: int
    is_file: bool = False
    """Whether it is the one record of its file."""
    time: str = ""
    """Column of the time stamps and its pattern, in words."""
    notes: tuple[str, ...] = ()
    """Changes made to the values."""

    def rows(self, rows: slice | Rows) -> TablePart:
        """Return the part with these rows alone."""
        skipped = (rows.start or 0) if isinstance(rows, slice) else 0
        return replace(
            self,
            u=self.u[rows],
            y=self.y[rows],
            timestamps=None if self.timestamps is None else self.timestamps[rows],
            first_line=self.first_line + skipped,
        )


def expanded(sheet: FileTable, wanted: Wanted) -> Wanted:
    """Replace the name of a matrix by its columns."""

    def columns(names: Sequence[str]) -> tuple[str, ...]:
        found = [(n, find_channels(sheet.columns, n)) for n in names]
        return tuple(c for n, many in found for c in (many if len(many) > 1 else (n,)))

    inputs, outputs = columns(wanted.inputs), columns(wanted.outputs)
    return replace(wanted, inputs=inputs, outputs=outputs)


def parts(sheet: FileTable, wanted: Wanted) -> list[TablePart]:
    """The channels as numbers; values that the user calls missing are NaN.

    Raises:
        UserError: where a column is missing or holds no numbers
    """
    for name in wanted.names:
        require_column(sheet, name)
    names = (*wanted.inputs, *wanted.outputs)
    values = {
        n: to_numbers(
            require_column(sheet, n).cells, f"{sheet.where}, column '{n}'", sheet.first_line
        )
        for n in names
    }
    notes: list[str] = []
    for entry in wanted.missing:
        for n in names if entry.signal is None else {entry.signal} & set(names):
            marked = entry.marks(values[n])
            if marked.any():
                values[n] = np.where(marked, np.nan, values[n])
                count = _many(int(marked.sum()), "value")
                notes.append(f"{sheet.where}: {count} of {n} missing {_why(entry)}")
    if any(require_column(sheet, n).seconds is None for n in names):
        whole = _one_clock(sheet, wanted, values)
    else:
        whole = _merged(sheet, wanted, values)
    whole = replace(whole, notes=tuple(notes))
    if wanted.experiment is None:
        return [whole]
    labels = [_label(c) for c in require_column(sheet, wanted.experiment).cells]
    column = np.array(labels, dtype=object)
    return [
        replace(
            whole.rows(np.flatnonzero(column == label)),
            name=label,
            where=f"{whole.where}, experiment {label}",
        )
        for label in _distinct(labels)
    ]


def _why(entry: Missing) -> str:
    """The reason why values are missing."""
    if entry.code is not None:
        return f"by the code {entry.code:g}"
    low, high = (-np.inf if entry.min is None else entry.min), entry.max
    return f"outside {low:g} to {np.inf if high is None else high:g}"


def units(sheet: FileTable, names: Sequence[str]) -> dict[str, str]:
    """Units that the file gives."""
    found = {n: find_column(list(sheet.columns), n) for n in names}
    return {n: sheet.columns[c].unit for n, c in found.items() if c and sheet.columns[c].unit}


def _one_clock(sheet: FileTable, wanted: Wanted, values: Mapping[str, Array]) -> TablePart:
    if len({len(v) for v in values.values()}) > 1:
        many = ", ".join(f"{n} {len(v)}" for n, v in values.items())
        raise UserError(f"{sheet.where}: channels of unequal lengths and without times ({many})")
    u = np.stack([values[n] for n in wanted.inputs], axis=1)
    y = np.stack([values[n] for n in wanted.outputs], axis=1)
    time = time_column(sheet, wanted)
    line = None if time is None else read_times(sheet, time, wanted)
    timestamps = None if line is None else line.seconds
    part = TablePart(
        sheet.name, u, y, timestamps, sheet.sampling_time, sheet.where, sheet.first_line,
        time="" if line is None else line.text,
    )  # fmt: skip
    if timestamps is None or np.isfinite(timestamps).all():
        return part
    unknown = _many(int((~np.isfinite(timestamps)).sum()), "row")
    part = replace(part, time=f"{part.time}, {unknown} without a stamp left out")
    return part.rows(np.flatnonzero(np.isfinite(timestamps)))


def _merged(sheet: FileTable, wanted: Wanted, values: Mapping[str, Array]) -> TablePart:
    """Channels with times of their own on those of the fastest: inputs held, outputs where they
    were measured."""
    times = {n: require_column(sheet, n).seconds for n in values}
    axes = {n: t for n, t in times.items() if t is not None and len(t)}
    for name in values:
        if name not in axes:
            raise UserError(f"{sheet.where}: channel '{name}' has no samples")
    steps = {n: float(np.median(np.diff(t))) if len(t) > 1 else np.inf for n, t in axes.items()}
    quick = min(steps.values())
    # Inputs are held between stamps, outputs are not: an output's stamps serve best.
    leader = next(n for n in (*wanted.outputs, *wanted.inputs) if steps[n] <= quick * 1.01)
    first = max(float(axes[n][0]) for n in wanted.inputs)
    ends = [float(axes[n][-1]) + (steps[n] if n in wanted.inputs else 0.0) for n in axes]
    base = axes[leader]
    near = 1e-6 * quick if np.isfinite(quick) else 0.0
    base = base[(base >= first - near) & (base <= min(ends) + near)]
    step = float(np.median(np.diff(base))) if len(base) > 1 else 1.0
    u = [held(axes[n], values[n][:, None], base)[:, 0] for n in wanted.inputs]
    y = [_placed(axes[n], values[n], base, step) for n in wanted.outputs]
    timestamps = np.round(base - base[0], 9) if len(base) else base
    return TablePart(
        sheet.name,
        np.stack(u, axis=1),
        np.stack(y, axis=1),
        timestamps,
        sheet.sampling_time,
        sheet.where,
        1,
    )


def _placed(timestamps: Array, values: Array, at: Array, step: float) -> Array:
    """Place values at their measured times, NaN at all others."""
    if not len(at):
        return np.zeros(0)
    near = np.clip(np.searchsorted(timestamps, at), 1, max(len(timestamps) - 1, 1))
    near -= (at - timestamps[near - 1]) < (timestamps[np.minimum(near, len(timestamps) - 1)] - at)
    near = np.clip(near, 0, len(timestamps) - 1)
    return np.where(np.abs(timestamps[near] - at) <= JITTER * step, values[near], np.nan)


def _distinct(labels: Sequence[str]) -> list[str]:
    """Labels in the order in which they come up; rows without one have no experiment."""
    return [name for name in dict.fromkeys(labels) if name]


def _label(cell: object) -> str:
    if isinstance(cell, float | np.floating) and float(cell).is_integer():
        return str(int(cell))
    text = "" if cell is None else str(cell).strip()
    return "".join(c if c.isprintable() else "_" for c in text)


# Conversion of laboratory files to records, with notes on the changes.


Use = Literal["train", "test", "split"]
"""Training records, test records, and records whose last part becomes a test."""
IGNORE_STAMPS = (
    'ignore them: --time none and --sampling-time, or time = "none" in [data] of problem.toml'
)
_SAME = 1e-3
"""Share by which two sampling times may differ and still count as one."""


@dataclass(frozen=True)
class Intake:
    """Records, and notes on how they were made."""

    records: tuple[Trajectory, ...]
    units: Mapping[str, str] = field(default_factory=dict[str, str])
    """Units that the files give, by channel."""
    notes: tuple[str, ...] = ()
    """Findings and changes, in plain words."""
    readings: tuple[str, ...] = ()
    """Sampling time of each file, and the evidence for it."""
    inputs: tuple[str, ...] = ()
    """Names of the inputs, with the columns of a matrix in place of its name."""
    outputs: tuple[str, ...] = ()
    """Names of the outputs, likewise."""


def take_in(
    paths: Sequence[Path],
    wanted: Wanted,
    use: Use,
    sampling_time: float | None = None,
    least: int = 1,
    only: Collection[str] | None = None,
    without: Collection[str] = (),
) -> Intake:
    """Read the records of `paths`: the one way from a file to a record.

    Outputs of a test are never interpolated.

    Args:
        sampling_time: s; None for the slowest one in the files
        least: shortest segment in samples; shorter ones are left out
        only, without: names of experiments to read, or to leave out

    Raises:
        UserError: for files that cannot be read as records
    """
    found: list[TablePart] = []
    found_units: dict[str, str] = {}
    asked: Wanted | None = None
    check_time_unit(wanted.time_unit)
    for name in (entry.signal for entry in wanted.missing):
        if name is not None and name not in wanted.names:
            near = suggestion(name, wanted.names)
            raise UserError(f"[[data.missing]] names '{name}', which is no signal{near}")
    stems = Counter(path.stem for path in paths)
    for path in paths:
        for sheet in file_format(path).read(path, wanted):
            own = expanded(sheet, wanted)
            if asked is not None and own.names != asked.names:
                raise UserError(
                    f"{sheet.where} has the channels {', '.join(own.names)}, the files before it "
                    f"{', '.join(asked.names)}: name the columns one by one"
                )
            asked = own
            found_units = units(sheet, (*own.inputs, *own.outputs)) | found_units
            for part in parts(sheet, own):
                name = part.name
                if name == path.stem and stems[name] > 1:
                    name = f"{path.resolve().parent.name}/{name}"
                part = replace(part, name=name, is_file=part.where == str(path))
                found.append(part if own.time_step is None else _as_sampled(part, own.time_step))
    known = [part.name for part in found]
    for name in (*(only or ()), *without):
        if name not in known:
            raise UserError(
                f"no experiment '{name}' in {', '.join(map(str, paths))} (there are "
                f"{', '.join(dict.fromkeys(known))}){suggestion(name, known)}"
            )
    kept = [p for p in found if (only is None or p.name in only) and p.name not in without]
    if found and not kept:
        raise UserError(
            f"every experiment of {', '.join(map(str, paths))} is held out as a test: leave one "
            "to train on"
        )
    asked = asked or wanted
    if asked.time_step is not None:
        before, after = asked.inputs[: asked.time_step], asked.inputs[asked.time_step :]
        asked = replace(asked, inputs=(*before, "time step", *after))
    _check_values(kept, asked, ", ".join(map(str, paths)))
    made = _without_rows(make_records(kept, use, sampling_time, least), asked)
    return replace(made, units=found_units, inputs=asked.inputs, outputs=asked.outputs)


def _without_rows(found: Intake, wanted: Wanted) -> Intake:
    """Take out the rows of outputs that `[[data.missing]]` names. Raises UserError for rows of an
    input."""
    records, notes = list(found.records), list(found.notes)
    for entry in wanted.missing:
        if entry.rows is None:
            continue
        if entry.signal in wanted.inputs:
            raise UserError(
                f"[[data.missing]] names rows of input '{entry.signal}', and a model needs every "
                "input: leave the cells empty in the file, which cuts the record there"
            )
        first, last = entry.rows
        columns = [n for n, y in enumerate(wanted.outputs) if entry.signal in (None, y)]
        for k, record in enumerate(records):
            if entry.record in (None, record.name):
                y = record.measured_y.copy()
                y[max(first - 1, 0) : last, columns] = np.nan
                records[k] = replace(record, y=y, missing=None)
                notes.append(f"record '{record.name}': rows {first} to {last} count as missing")
    return replace(found, records=tuple(records), notes=tuple(notes))


def _as_sampled(part: TablePart, place: int) -> TablePart:
    """Insert the time to the next sample among the inputs, at this place; the last sample gets the
    median. Raises UserError for time stamps that do not increase."""
    if part.timestamps is None or len(part.timestamps) < 2:
        raise UserError(f"{part.where}: irregular sampling needs a column with time stamps")
    cuts = runs(part.timestamps, part.where, part.first_line, IGNORE_STAMPS)
    if len(cuts) > 1:
        raise UserError(
            f"{part.where}, line {part.first_line + cuts[1].start}: time goes back; put records "
            "into files of their own, or name experiment_column"
        )
    steps = np.diff(part.timestamps)
    steps = np.append(steps, np.median(steps))
    return replace(part, u=np.insert(part.u, place, steps, axis=1), timestamps=None)


def _check_values(found: Sequence[TablePart], wanted: Wanted, where: str) -> None:
    """Raise UserError for a channel that has no value in any row, and for outputs that are measured
    only where inputs are not."""
    if not any(len(part.u) for part in found):
        return
    rows = sum(len(part.u) for part in found)
    known_u = np.any([np.isfinite(part.u).any(axis=0) for part in found], axis=0)
    known_y = np.any([np.isfinite(part.y).any(axis=0) for part in found], axis=0)
    channels = (("input", wanted.inputs, known_u), ("output", wanted.outputs, known_y))
    for kind, names, known in channels:
        for name in (n for n, is_known in zip(names, known, strict=True) if not is_known):
            raise UserError(
                f"{where}: {kind} '{name}' has no value in any of {rows} rows: name another "
                "column, or bring records in which it was measured"
            )
    if not any(np.isfinite(p.y[np.isfinite(p.u).all(axis=1)]).any() for p in found):
        raise UserError(
            f"{where}: no row has every input and an output: a row must hold what was measured at "
            "one time; put the last value of each input into the rows with outputs"
        )


def make_records(
    found: Sequence[TablePart],
    use: Use,
    sampling_time: float | None = None,
    least: int = 1,
    ignore: str = IGNORE_STAMPS,
) -> Intake:
    """Put channels on one time grid, cut them at gaps, and name the records. ignore: how the user
    can do without the time stamps, for messages. Raises UserError."""
    notes = list(dict.fromkeys(note for part in found for note in part.notes))
    whole: list[list[tuple[TablePart, Clock | None]]] = []
    for part in found:
        stamps = part.timestamps
        if stamps is None:
            whole.append([(part, None)])
            continue
        if len(stamps) >= 3 and (np.diff(stamps) <= 0).all():
            notes.append(f"{part.where}: the newest row came first, the order was turned round")
            part, stamps = part.rows(slice(None, None, -1)), stamps[::-1]
        cuts = runs(stamps, part.where, part.first_line, ignore)
        if len(cuts) > 1:
            back = _many(len(cuts) - 1, "time")
            notes.append(f"{part.where}: time goes back {back}, a new record begins at each")
        whole.append([(part.rows(rows), clock(stamps[rows])) for rows in cuts])
    timed = [one for runs_of_part in whole for one in runs_of_part]
    where = ", ".join(dict.fromkeys(part.where for part in found))
    readings = tuple(_readings([(part, own) for part, own in timed if part.time and own]))
    step = _slowest(timed, where) if sampling_time is None else sampling_time
    grid = _Grid(step, use, ignore, notes)
    made: list[Trajectory] = []
    for runs_of_part in whole:
        part = runs_of_part[0][0]
        pieces = [piece for run in runs_of_part for piece in grid.put(*run)]
        cuts = [cut for piece in pieces for cut in _without_missing(piece)]
        _note_missing(part.where, pieces, cuts, notes)
        # A whole file that is too short is an error, which the folds raise.
        is_whole = part.is_file and len(cuts) == 1
        long = [cut for cut in cuts if is_whole or len(cut.u) >= least]
        if len(long) < len(cuts):
            lost = sum(len(cut.u) for cut in cuts if len(cut.u) < least)
            notes.append(
                f"{part.where}: {_many(len(cuts) - len(long), 'piece')} shorter than {least} "
                f"samples left out ({lost} samples)"
            )
        if len(long) > 1:
            notes.append(f"{part.where}: cut into {len(long)} records")
        made += [
            Trajectory(cut.u, cut.y, step, part.name if len(long) == 1 else f"{part.name}_{k}")
            for k, cut in enumerate(long, 1)
        ]
    if not made:
        found_here = f" ({'; '.join(dict.fromkeys(notes))})" if notes else ""
        raise UserError(
            f"no piece of {where} has {_many(least, 'sample')} in a row{found_here}: bring records "
            f"of at least {_many(least, 'sample')} without gaps in time and with every input"
        )
    names = unique_names([t.name for t in made])
    records = tuple(replace(t, name=n) for t, n in zip(made, names, strict=True))
    return Intake(records, notes=tuple(notes), readings=readings)


def _readings(timed: Sequence[tuple[TablePart, Clock]]) -> Iterator[str]:
    """The sampling time of each file, with its evidence."""
    counts: Counter[tuple[str, str, str, str]] = Counter()
    for part, own in timed:
        kind = "equal steps" if own.regular else "uneven steps"
        stamps = np.zeros(0) if part.timestamps is None else part.timestamps
        steps = np.diff(places(stamps, own.step))
        counts[part.where, f"{own.step:g}", part.time, kind] += int((steps == 1).sum())
    for (where, step, time, kind), count in counts.items():
        yield f"{where}: sampled every {step} s: {time}, {count} {kind}"


def as_written(sheet: FileTable, wanted: Wanted, sampling_time: float) -> Trajectory:
    """The record whose samples are the rows of a sheet, whatever its time stamps: of files that
    ASIA wrote and of benchmarks. Raises UserError."""
    part = parts(sheet, replace(wanted, time="none", experiment=None))[0]
    return Trajectory(part.u, part.y, sampling_time, sheet.name)


def _slowest(timed: Sequence[tuple[TablePart, Clock | None]], where: str) -> float:
    steps = [part.sampling_time if own is None else own.step for part, own in timed]
    known = [step for step in steps if step is not None]
    if not known and any(part.timestamps is not None for part, _ in timed):
        rows = sum(len(part.u) for part, _ in timed)
        raise UserError(
            f"{where}: {_many(rows, 'row')} with a time stamp, too few to find the sampling time: "
            "bring longer records"
        )
    if not known:
        raise UserError(
            f"{where}: no column with time stamps was found: give --sampling-time in seconds, or "
            "name the column with --time"
        )
    slowest = max(known)
    # Clocks of several records differ by the drift of a quartz: this is one sampling time.
    alike = [s for s in known if abs(s - slowest) <= _SAME * slowest]
    return min(alike, key=lambda s: (len(f"{s:.12g}"), s))


@dataclass(frozen=True)
class _Grid:
    """Time grid of all records; changes of a part are added to the notes."""

    step: float
    use: Use
    ignore: str
    notes: list[str]

    def put(self, part: TablePart, own_clock: Clock | None) -> list[TablePart]:
        """Resample a part to the grid, and cut it at its gaps."""
        step, where = self.step, part.where
        if own_clock is None or part.timestamps is None:
            own, pieces = part.sampling_time or step, [part]
        elif not own_clock.regular:
            return self._resampled(part, part.timestamps, own_clock)
        else:
            own = own_clock.step
            if own_clock.coarse and own_clock.jitter > 1e-6:
                self.notes.append(f"{where}: stamps rounded to coarse steps lie on a grid")
            pieces = [part.rows(rows) for rows in segments(places(part.timestamps, own))]
            if len(pieces) > 1:
                self.notes.append(f"{where}: {_many(len(pieces) - 1, 'gap')} in time")
        if abs(own - step) <= _SAME * step:
            return pieces
        if own > 1.5 * step:
            raise UserError(
                f"{where}: it is sampled every {own:g} s, but the sampling time is {step:g} s: "
                "give that sampling time, or the unit of the time stamps (--time-unit, or "
                f"time_unit in [data]); if the stamps are wrong, {self.ignore}"
            )
        ratio = step / own
        count = round(ratio)
        if abs(ratio - count) < _SAME * ratio and ratio > 1:
            self.notes.append(
                f"{where}: sampled every {own:g} s, one output in {count} is kept and the inputs "
                "are averaged in between"
            )
            lengths = [len(piece.u) // count for piece in pieces]
            return [
                replace(
                    piece,
                    u=piece.u[: rows * count].reshape(rows, count, -1).mean(axis=1),
                    y=piece.y[: rows * count : count],
                    timestamps=None,
                )
                for piece, rows in zip(pieces, lengths, strict=True)
                if rows
            ]
        return [
            one
            for piece in pieces
            for one in self._resampled(
                piece, np.arange(len(piece.u), dtype=np.float64) * own, Clock(own, 0.0)
            )
        ]

    def _resampled(self, part: TablePart, timestamps: Array, own: Clock) -> list[TablePart]:
        # Beyond a jitter of half a sample the stamps follow no one grid.
        if own.jitter > 0.5:
            low, high = np.quantile(np.diff(timestamps), (0.01, 0.99))
            reason = f"the sampling time varies from {low:.3g} s to {high:.3g} s"
        elif own.jitter > 0:
            reason = f"the time stamps jitter by {own.jitter:.1%} of a sample"
        else:
            reason = f"it is sampled every {own.step:g} s"
        if self.use != "train":
            mend = f"bring a test record sampled every {self.step:g} s"
            if self.use == "split":
                mend = f"keep the last part for training (--no-seal) and {mend}"
            if own.jitter > 0:
                mend += f"; if only the stamps are wrong, {self.ignore}"
            raise UserError(
                f"{part.where}: {reason}, and outputs of a test are never interpolated: {mend}"
            )
        self.notes.append(
            f"{part.where}: {reason}; resampled to {self.step:g} s: inputs held, outputs on "
            "straight lines between their neighbours"
        )
        gap = 2.5 * max(own.step, self.step)
        breaks = (np.flatnonzero(np.diff(timestamps) > gap) + 1).tolist()
        if breaks:
            self.notes.append(f"{part.where}: {_many(len(breaks), 'gap')} in time")
        made: list[TablePart] = []
        for a, b in zip([0, *breaks], [*breaks, len(timestamps)], strict=True):
            stamps = timestamps[a:b]
            count = int((stamps[-1] - stamps[0]) / self.step + 1e-9) + 1
            at = stamps[0] + self.step * np.arange(count)
            u, y = held(stamps, part.u[a:b], at), between(stamps, part.y[a:b], at)
            made.append(replace(part, u=u, y=y, timestamps=None))
        return made


def _without_missing(part: TablePart) -> list[TablePart]:
    """Cut a part to the segments in which every input was measured; outputs may be missing, but not
    all of them at either end, and none of them everywhere."""
    rows = np.flatnonzero(np.isfinite(part.u).all(axis=1))
    kept: list[TablePart] = []
    for segment in segments(rows) if rows.size else ():
        first = int(rows[segment.start])
        known = ~np.isnan(part.y[first : int(rows[segment.stop - 1]) + 1])
        if not known.any(axis=0).all():
            continue
        # Samples with all outputs measured are the limits where there are any.
        whole = known.all(axis=1) if known.all(axis=1).any() else known.any(axis=1)
        limits = first + np.flatnonzero(whole)
        kept.append(part.rows(slice(int(limits[0]), int(limits[-1]) + 1)))
    return kept


def _note_missing(
    where: str, found: Sequence[TablePart], cuts: Sequence[TablePart], notes: list[str]
) -> None:
    """One line for each kind of missing value in a record."""
    good = [np.isfinite(part.u).all(axis=1) for part in found]
    unknown = sum(int((~rows).sum()) for rows in good)
    if unknown:
        notes.append(f"{where}: cut where inputs are missing ({unknown} samples)")
    lost = sum(int(np.isnan(cut.y).sum()) for cut in cuts)
    if lost:
        notes.append(
            f"{where}: {lost} of {sum(cut.y.size for cut in cuts)} {NOT_MEASURED}; they do not "
            "count"
        )
    outside = sum(int(rows.sum()) for rows in good) - sum(len(cut.u) for cut in cuts)
    if outside:
        notes.append(f"{where}: {_many(outside, 'sample')} without measured outputs left out")


def _many(count: int, what: str) -> str:
    return f"{count} {what}" + ("s" if count != 1 else "")


# Survey of the files of a folder before inputs and outputs are chosen.


_INPUT = re.compile(r"(u|in|input)[ _.]?\d*")
_OUTPUT = re.compile(r"(y|out|output)[ _.]?\d*")
_REFERENCE = re.compile(r"(r|ref|reference|set[ _]?point|sp)[ _.]?\d*")


@dataclass(frozen=True)
class FileColumns:
    """Columns of a file, with a guess at inputs and outputs."""

    names: tuple[str, ...]
    """All but that of the sample times, without their units."""
    time: str | None
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
    def references(self) -> tuple[str, ...]:
        """Likely references of a control loop by their names, which are no inputs of the plant."""
        return references_among(self.names)

    @property
    def _usable(self) -> tuple[str, ...]:
        left = tuple(n for n in self.names if n not in self.unusable)
        signals = tuple(n for n in left if n not in self.references)
        return signals if len(signals) > 1 else left

    def _named(self, pattern: re.Pattern[str]) -> tuple[str, ...]:
        return tuple(n for n in self._usable if pattern.fullmatch(n.casefold()))


def references_among(names: Iterable[str]) -> tuple[str, ...]:
    """Names that a measured reference usually has, such as r, ref, setpoint or sp."""
    return tuple(n for n in names if _REFERENCE.fullmatch(n.casefold()))


def survey(path: Path, wanted: Wanted) -> FileColumns:
    """The columns of a file with records. Raises UserError."""
    fmt = file_format(path)
    sheets = fmt.read(path, wanted)
    if any(not len(c.cells) for s in sheets for c in s.columns.values()):
        # Some formats read only the columns that are asked for.
        every = tuple(dict.fromkeys(n for s in sheets for n in s.columns))
        sheets = fmt.read(path, replace(wanted, inputs=every, outputs=()))
    whole = FileTable(
        path.stem, {n: c for s in sheets for n, c in s.columns.items()}, where=str(path)
    )
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


def _why_unusable(name: str, sheets: Sequence[FileTable]) -> str:
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
            cells = require_column(sheet, wanted.experiment).cells
            found += _distinct([_label(cell) for cell in cells])
    return tuple(dict.fromkeys(found))


def record_files(folder: Path) -> tuple[list[Path], list[Path]]:
    """Files in a folder that may hold records, in the order of their names: for training, and those
    whose names say that they are for a test. Empty where there are too many to be meant."""
    suffixes = {s for fmt in FORMATS for s in fmt.suffixes if s != "/"}
    found = sorted(p for p in folder.iterdir() if p.is_file() and p.suffix.lower() in suffixes)
    if len(found) > 50:
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
