"""Conversion of laboratory files to records, with notes on the changes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np

from asia._nearest import suggestion
from asia.data._trajectory import Array, Trajectory, unique_names
from asia.data.intake.formats.table import read_sheets
from asia.data.intake.grid import (
    Clock,
    between,
    clock,
    held,
    places,
    runs,
    segments,
)
from asia.data.intake.part import SheetPart, expanded, parts, units
from asia.data.intake.sheet import Sheet, Wanted
from asia.errors import UserError

Use = Literal["train", "test", "split"]
"""Training records, test records, and records whose last part becomes a test."""
IGNORE_STAMPS = (
    'ignore them: --time none and --sampling-time, or time = "none" in [data] of problem.toml'
)
_SAME = 1e-3
_EXACT = 1e-6
_GAP = 2.5
_COARSER = 1.5
_DRIFT = 0.5
"""Jitter, as a share of a sample, from which on the stamps follow no one grid."""


@dataclass(frozen=True)
class Intake:
    """Records, and notes on how they were made."""

    records: tuple[Trajectory, ...]
    units: Mapping[str, str] = field(default_factory=dict[str, str])
    """Units that the files give, by channel."""
    notes: tuple[str, ...] = ()
    """Findings and changes, in plain words."""
    inputs: tuple[str, ...] = ()
    """Names of the inputs, with the columns of a matrix in place of its name."""
    outputs: tuple[str, ...] = ()
    """Names of the outputs, likewise."""


@dataclass(frozen=True)
class _Timed:
    """Part in which time increases.

    Attributes:
        clock: None where the file has no usable time stamps
    """

    part: SheetPart
    clock: Clock | None


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
    found: list[SheetPart] = []
    found_units: dict[str, str] = {}
    asked: Wanted | None = None
    stems = Counter(path.stem for path in paths)
    for path in paths:
        for sheet in read_sheets(path, wanted):
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
                found.append(replace(part, name=name, is_file=part.where == str(path)))
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
    _check_values(kept, asked, ", ".join(map(str, paths)))
    made = make_records(kept, use, sampling_time, least)
    return replace(made, units=found_units, inputs=asked.inputs, outputs=asked.outputs)


def _check_values(found: Sequence[SheetPart], wanted: Wanted, where: str) -> None:
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
    found: Sequence[SheetPart],
    use: Use,
    sampling_time: float | None = None,
    least: int = 1,
    ignore: str = IGNORE_STAMPS,
) -> Intake:
    """Put channels on one time grid, cut them at gaps, and name the records. ignore: how the user
    can do without the time stamps, for messages. Raises UserError."""
    notes: list[str] = []
    timed = [one for part in found for one in _stretches(_oldest_first(part, notes), ignore, notes)]
    where = ", ".join(dict.fromkeys(part.where for part in found))
    step = _slowest(timed, where) if sampling_time is None else sampling_time
    made: list[Trajectory] = []
    for one in timed:
        made += _pieces(one, step, use, least, notes, ignore)
    if not made:
        found_here = f" ({'; '.join(dict.fromkeys(notes))})" if notes else ""
        raise UserError(
            f"no piece of {where} has {_many(least, 'sample')} in a row{found_here}: bring records "
            f"of at least {_many(least, 'sample')} without gaps in time and with every input"
        )
    names = unique_names([t.name for t in made])
    records = tuple(replace(t, name=n) for t, n in zip(made, names, strict=True))
    return Intake(records, notes=tuple(notes))


def as_written(sheet: Sheet, wanted: Wanted, sampling_time: float) -> Trajectory:
    """The record whose samples are the rows of a sheet, whatever its time stamps: of files that
    ASIA wrote and of benchmarks. Raises UserError."""
    part = parts(sheet, replace(wanted, time="none", experiment=None))[0]
    return Trajectory(part.u, part.y, sampling_time, sheet.name)


def _oldest_first(part: SheetPart, notes: list[str]) -> SheetPart:
    """Return the part in increasing time; reverse it where time decreases from row to row."""
    if (
        part.timestamps is None
        or len(part.timestamps) < 3
        or not (np.diff(part.timestamps) <= 0).all()
    ):
        return part
    notes.append(f"{part.where}: the newest row came first, the order was turned round")
    back = slice(None, None, -1)
    return replace(part, u=part.u[back], y=part.y[back], timestamps=part.timestamps[back])


def _stretches(part: SheetPart, ignore: str, notes: list[str]) -> list[_Timed]:
    if part.timestamps is None:
        return [_Timed(part, None)]
    found = runs(part.timestamps, part.where, part.first_line, ignore)
    if len(found) > 1:
        back = _many(len(found) - 1, "time")
        notes.append(f"{part.where}: time goes back {back}, a new record begins at each")
    return [_Timed(cut, clock(_timestamps(cut))) for cut in (_cut(part, rows) for rows in found)]


def _cut(part: SheetPart, rows: slice) -> SheetPart:
    timestamps = None if part.timestamps is None else part.timestamps[rows]
    line = part.first_line + rows.start
    return replace(part, u=part.u[rows], y=part.y[rows], timestamps=timestamps, first_line=line)


def _timestamps(part: SheetPart) -> Array:
    return np.zeros(0) if part.timestamps is None else part.timestamps


def _own_step(one: _Timed) -> float | None:
    return one.part.sampling_time if one.clock is None else one.clock.step


def _slowest(timed: Sequence[_Timed], where: str) -> float:
    known = [step for step in map(_own_step, timed) if step is not None]
    rows = sum(len(one.part.u) for one in timed)
    if not known and any(one.part.timestamps is not None for one in timed):
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


def _pieces(
    one: _Timed, step: float, use: Use, least: int, notes: list[str], ignore: str
) -> list[Trajectory]:
    on_grid = _on_grid(one, step, use, notes, ignore)
    cuts = [cut for whole in on_grid for cut in _without_missing(whole)]
    _note_missing(one.part.where, on_grid, cuts, notes)
    # A whole file that is too short is an error, which the folds raise.
    is_whole = one.part.is_file and len(cuts) == 1
    long = [cut for cut in cuts if is_whole or len(cut.u) >= least]
    if len(long) < len(cuts):
        lost = sum(len(cut.u) for cut in cuts if len(cut.u) < least)
        notes.append(
            f"{one.part.where}: {_many(len(cuts) - len(long), 'piece')} shorter than {least} "
            f"samples left out ({lost} samples)"
        )
    if len(long) > 1:
        notes.append(f"{one.part.where}: cut into {len(long)} records")
    name = one.part.name
    return [
        Trajectory(cut.u, cut.y, step, name if len(long) == 1 else f"{name}_{k}")
        for k, cut in enumerate(long, 1)
    ]


def _on_grid(one: _Timed, step: float, use: Use, notes: list[str], ignore: str) -> list[SheetPart]:
    """Resample a part to the sampling time `step`, and cut it at its gaps."""
    part = one.part
    own = _own_step(one) or step
    if one.clock is not None and not one.clock.regular:
        return _resampled(part, one.clock, step, use, notes, ignore)
    if one.clock is None:
        whole = [part]
    else:
        if one.clock.coarse and one.clock.jitter > _EXACT:
            notes.append(f"{part.where}: stamps rounded to coarse steps lie on a grid")
        cuts = segments(places(_timestamps(part), own))
        if len(cuts) > 1:
            notes.append(f"{part.where}: {_many(len(cuts) - 1, 'gap')} in time")
        whole = [_cut(part, rows) for rows in cuts]
    if abs(own - step) <= _SAME * step:
        return whole
    if own > _COARSER * step:
        raise UserError(
            f"{part.where}: it is sampled every {own:g} s, but the sampling time is {step:g} s: "
            "give that sampling time, or the unit of the time stamps (--time-unit, or time_unit in "
            f"[data]); if the stamps are wrong, {ignore}"
        )
    return _other_rate(whole, own, step, use, notes, ignore)


def _other_rate(
    whole: Sequence[SheetPart], own: float, step: float, use: Use, notes: list[str], ignore: str
) -> list[SheetPart]:
    ratio = step / own
    where = whole[0].where
    if abs(ratio - round(ratio)) < _SAME * ratio and ratio > 1:
        count = round(ratio)
        notes.append(
            f"{where}: sampled every {own:g} s, one output in {count} is kept and the inputs are "
            "averaged in between"
        )
        return [_decimated(part, count) for part in whole if len(part.u) >= count]
    made: list[SheetPart] = []
    for part in whole:
        timestamps = np.arange(len(part.u), dtype=np.float64) * own
        timed = SheetPart(part.name, part.u, part.y, timestamps, own, part.where, part.first_line)
        made += _resampled(timed, Clock(own, 0.0), step, use, notes, ignore)
    return made


def _decimated(part: SheetPart, count: int) -> SheetPart:
    rows = len(part.u) // count
    u = part.u[: rows * count].reshape(rows, count, -1).mean(axis=1)
    return SheetPart(
        part.name, u, part.y[: rows * count : count], None, None, part.where, part.first_line
    )


def _resampled(
    part: SheetPart, found: Clock, step: float, use: Use, notes: list[str], ignore: str
) -> list[SheetPart]:
    if found.jitter > _DRIFT:
        low, high = np.quantile(np.diff(_timestamps(part)), (0.01, 0.99))
        reason = f"the sampling time varies from {low:.3g} s to {high:.3g} s"
    elif found.jitter > 0:
        reason = f"the time stamps jitter by {found.jitter:.1%} of a sample"
    else:
        reason = f"it is sampled every {found.step:g} s"
    if use != "train":
        mend = f"bring a test record sampled every {step:g} s"
        if use == "split":
            mend = f"keep the last part for training (--no-seal) and {mend}"
        if found.jitter > 0:
            mend += f"; if only the stamps are wrong, {ignore}"
        raise UserError(
            f"{part.where}: {reason}, and outputs of a test are never interpolated: {mend}"
        )
    notes.append(
        f"{part.where}: {reason}; resampled to {step:g} s: inputs held, outputs on straight lines "
        "between their neighbours"
    )
    timestamps = _timestamps(part)
    breaks = (np.flatnonzero(np.diff(timestamps) > _GAP * max(found.step, step)) + 1).tolist()
    if breaks:
        notes.append(f"{part.where}: {_many(len(breaks), 'gap')} in time")
    made: list[SheetPart] = []
    for a, b in zip([0, *breaks], [*breaks, len(timestamps)], strict=True):
        own = timestamps[a:b]
        at = own[0] + step * np.arange(int((own[-1] - own[0]) / step + 1e-9) + 1)
        u, y = held(own, part.u[a:b], at), between(own, part.y[a:b], at)
        made.append(SheetPart(part.name, u, y, None, None, part.where, part.first_line + a))
    return made


def _without_missing(part: SheetPart) -> list[SheetPart]:
    """Cut a part to the segments in which every input was measured; outputs may be missing, but not
    all of them at either end."""
    rows = np.flatnonzero(np.isfinite(part.u).all(axis=1)).astype(np.int64)
    if not rows.size:
        return []
    spans = (slice(int(rows[s.start]), int(rows[s.stop - 1]) + 1) for s in segments(rows))
    return [one for rows in spans for one in _measured_segment(_cut(part, rows))]


def _measured_segment(part: SheetPart) -> list[SheetPart]:
    """Cut the part to the samples between the first and the last with measured outputs.

    Samples with all outputs measured are the limits where there are any. Returns [] where an output
    was never measured.
    """
    known = ~np.isnan(part.y)
    if not known.any(axis=0).all():
        return []
    whole = known.all(axis=1) if known.all(axis=1).any() else known.any(axis=1)
    rows = np.flatnonzero(whole)
    return [_cut(part, slice(int(rows[0]), int(rows[-1]) + 1))]


def _note_missing(
    where: str, found: Sequence[SheetPart], cuts: Sequence[SheetPart], notes: list[str]
) -> None:
    """One line for each kind of missing value in a record."""
    good = [np.isfinite(part.u).all(axis=1) for part in found]
    unknown = sum(int((~rows).sum()) for rows in good)
    if unknown:
        notes.append(f"{where}: cut where inputs are missing ({unknown} samples)")
    lost = sum(int(np.isnan(cut.y).sum()) for cut in cuts)
    if lost:
        notes.append(
            f"{where}: {lost} of {sum(cut.y.size for cut in cuts)} output values were not "
            "measured; they do not count"
        )
    outside = sum(int(rows.sum()) for rows in good) - sum(len(cut.u) for cut in cuts)
    if outside:
        notes.append(f"{where}: {_many(outside, 'sample')} without measured outputs left out")


def _many(count: int, what: str) -> str:
    return f"{count} {what}" + ("s" if count != 1 else "")
