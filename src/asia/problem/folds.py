"""Folds of a protocol: cut points, cases with past windows, held-out blocks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from asia.data.segment import Segment
from asia.data.trajectory import LEAST_RANGE, Array, Trajectory, filled, spread_of
from asia.errors import UserError
from asia.problem.protocol import FoldRule, ProtocolRule

# Cut points of folds and windows in records, in 0-based samples.


@dataclass(frozen=True)
class Excerpt:
    """Contiguous samples of a record."""

    record: int
    samples: range


@dataclass(frozen=True)
class FoldCut:
    """Held-out and training samples of one fold; the past windows before a block are not part of
    it."""

    held_out: tuple[Excerpt, ...]
    train: tuple[Excerpt, ...]


def splits(names: Sequence[str], lengths: Sequence[int], rule: ProtocolRule) -> list[FoldCut]:
    """The folds of records of these names and lengths; empty parts where a record is too short."""
    if rule.folds.kind == "leave_one_group_out":
        records = list(zip(names, lengths, strict=True))
        return [
            FoldCut(
                tuple(
                    Excerpt(i, range(rule.past, length))
                    for i, (name, length) in enumerate(records)
                    if name in group.records
                ),
                tuple(
                    Excerpt(i, range(length))
                    for i, (name, length) in enumerate(records)
                    if name not in group.records
                ),
            )
            for group in rule.folds.groups
        ]
    cuts = [_held_out_blocks(length, rule) for length in lengths]
    return [
        FoldCut(
            tuple(Excerpt(i, block) for i, blocks in enumerate(cuts) for block in blocks[k]),
            tuple(
                Excerpt(i, rest)
                for i, blocks in enumerate(cuts)
                for rest in _training_parts(lengths[i], blocks[k], rule)
            ),
        )
        for k in range(rule.folds.count)
    ]


def block_count(rule: ProtocolRule) -> int:
    """Into how many blocks a record is cut: in forward folds the first one trains only."""
    return rule.folds.count + (rule.folds.kind == "forward")


def least_case(rule: ProtocolRule) -> int:
    """Samples of the shortest case."""
    return rule.horizon or 1


def _held_out_blocks(length: int, rule: ProtocolRule) -> list[list[range]]:
    """Return the held-out blocks of each fold: one, empty where the record is too short, and with a
    period one in each period.

    The samples after the first past window (in tail folds: the tail) are split into `block_count`
    parts; the first parts are one sample longer when the length does not divide.
    """
    count, start, period = block_count(rule), rule.past, rule.folds.period
    if period is not None:
        edges = [k * period // count for k in range(count + 1)]
        return [
            [
                range(max(first + low, start), min(first + high, length))
                for first in range(0, length, period)
                if min(first + high, length) - max(first + low, start) >= least_case(rule)
            ]
            for low, high in pairwise(edges)
        ]
    if rule.folds.tail is not None:
        start = max(start, length - rule.folds.tail)
    size, longer = divmod(max(length - start, 0), count)
    edges = [start + k * size + min(k, longer) for k in range(count + 1)]
    return [[range(start, stop)] for start, stop in pairwise(edges)][count - rule.folds.count :]


def _training_parts(length: int, blocks: Sequence[range], rule: ProtocolRule) -> list[range]:
    """Return the samples that train while these blocks are held out.

    These are the samples before each block and, except in forward and tail folds, after it, without
    the gap. A part is kept if it is long enough for its own past window and one more case.
    """
    gap = rule.folds.gap or 0
    starts = [rule.past, *(block.stop + gap for block in blocks)]
    stops = [*(block.start - gap for block in blocks), length]
    parts = [range(start, stop) for start, stop in zip(starts, stops, strict=True)]
    if rule.folds.kind != "contiguous":
        parts = parts[:1]
    return [part for part in parts if len(part) >= rule.past + least_case(rule)]


def least_samples(rule: ProtocolRule) -> int:
    """The shortest training record that the folds can divide."""
    case = least_case(rule)
    # Ten samples are the least to train on.
    beyond = max(case, 10)
    if rule.folds.kind == "leave_one_group_out":
        return rule.past + beyond
    gap = rule.folds.gap or 0
    if rule.folds.period is not None:
        return rule.past + max(rule.folds.period, rule.folds.count * (rule.past + beyond + gap))
    if rule.folds.tail is not None:
        tail = max(rule.folds.tail, rule.folds.count * case)
        return rule.past + tail + rule.past + case + gap
    return rule.past + block_count(rule) * (rule.past + beyond + gap)


def require_length(trajectories: Sequence[Trajectory], rule: ProtocolRule) -> None:
    """Raise UserError when a record is too short for the folds: each held-out block must be able to
    hold a past window and some samples to train on."""
    gap, count = rule.folds.gap, rule.folds.count
    if rule.folds.kind == "leave_one_group_out":
        wanted = f"a past window of {rule.past}"
        advice = "a shorter past window"
    elif rule.folds.period is not None:
        wanted = f"{count} folds of a period of {rule.folds.period} with a past window of"
        wanted += f" {rule.past}"
        advice = "fewer folds, a shorter past window"
    elif rule.folds.tail is not None:
        wanted = f"a tail of {rule.folds.tail} in {count} folds with a past window of {rule.past}"
        advice = "fewer folds, a shorter tail or past window"
    else:
        wanted = f"{count} folds with a past window of {rule.past}"
        wanted += f" and a gap of {gap}" if gap else ""
        advice = "fewer folds, a shorter past window" + (" or gap" if gap else "")
    if rule.horizon is not None:
        wanted += f" and a horizon of {rule.horizon}"
        advice = f"{advice} or horizon"
    least = least_samples(rule)
    for t in trajectories:
        if len(t) < least:
            raise UserError(
                f"record '{t.name}' has {len(t)} samples, but {wanted} need at least {least}: "
                f"use {advice} or a longer record"
            )


def windows(samples: range, rule: ProtocolRule) -> list[range]:
    """The cases that cover `samples`: all of them at once, or windows of `horizon`, one after the
    other, the last of which ends with them and may overlap its neighbour; none when too short."""
    if rule.horizon is None:
        return [samples] if samples else []
    if len(samples) < rule.horizon:
        return []
    last = samples.stop - rule.horizon
    starts = [*range(samples.start, last, rule.horizon), last]
    return [range(start, start + rule.horizon) for start in starts]


# Training samples, simulated samples and past windows of each fold.


@dataclass(frozen=True, repr=False)
class Fold:
    """Training records and held-out blocks of one fold."""

    index: int
    train: tuple[Trajectory, ...]
    held_out: tuple[Segment, ...]
    """Held-out blocks, those of each record in time order."""
    scale: Array
    """Standard deviation (ny,), ddof 0, of each output over the training samples; with a horizon
    over the concatenated training windows."""
    followed: tuple[bool, ...] = ()
    """For each held-out block, whether later samples of its record train."""
    offsets: tuple[int, ...] = ()
    """For each training record, its first sample in the record that it was cut from; () where each
    is a whole record."""

    @property
    def shapes(self) -> list[tuple[int, ...]]:
        """Shapes (H, ny) of the outputs of the held-out blocks."""
        return [block.y.shape for block in self.held_out]

    def __repr__(self) -> str:
        train, held_out = sum(map(len, self.train)), sum(len(b.y) for b in self.held_out)
        return (
            f"<fold {self.index + 1}: {train} training samples in {len(self.train)} records, "
            f"{held_out} held out in {len(self.held_out)} blocks>"
        )


def cut(record: Trajectory, start: int, stop: int, rule: ProtocolRule, index: int = 0) -> Segment:
    """The block `record[start:stop]` with the past windows just before it."""
    if start < rule.past:
        raise UserError(
            f"record '{record.name}': simulation cannot start at sample {start + 1}, "
            f"the past window needs {rule.past} samples before it"
        )
    return Segment(
        past_u=record.u[start - rule.past_inputs : start],
        past_y=past_outputs(record.measured_y, start, rule.past_outputs, record.name),
        u=record.u[start:stop],
        y=record.measured_y[start:stop],
        name=record.name,
        record=index,
        start=start,
    )


def past_outputs(measured: Array, start: int, count: int, name: str) -> Array:
    """The `count` outputs before `start`.

    Where one was not measured it is filled from samples before `start` alone, so that none of those
    to simulate shows.

    Args:
        measured: (T, ny), NaN where an output was not measured
        name: of the record

    Raises:
        UserError: where there is none
    """
    window = slice(start - count, start)
    if not np.isnan(measured[window]).any():
        return measured[window]
    known = measured[:start]
    never = np.isnan(known).all(axis=0)
    if never.any():
        raise UserError(
            f"record '{name}': output {int(np.argmax(never)) + 1} is not measured before "
            f"sample {start + 1}, where a simulation starts from past outputs: cut the record so "
            "that it begins with a measured sample"
        )
    return filled(known)[window]


def whole(records: Sequence[Trajectory], rule: ProtocolRule) -> tuple[Segment, ...]:
    """Each record from its first past window to its end: one block, or one for each window.

    Windows follow each other every `horizon` samples; the last one ends with the record and may
    overlap its neighbour, so that N samples give ceil((N - past) / horizon) of them.
    """
    parts = [Excerpt(i, range(rule.past, len(r))) for i, r in enumerate(records)]
    return _blocks(records, parts, rule)


_THIRDS = 3


def make_folds(records: Sequence[Trajectory], rule: ProtocolRule) -> tuple[Fold, ...]:
    """Make the folds of a problem's training records.

    Contiguous: each record is split by `array_split` after its first past window. Segment k of
    every record is held out in fold k; the samples before and after it train, as records of their
    own. A training record too short to hold its own past window and one case is left out.

    Forward: one part more; part k + 1 is held out in fold k, and the samples before it train. Tail:
    as forward, with all parts in the last `folds.tail` samples. The samples of `folds.gap` next to
    a held-out part train nothing.

    Period: each period of a record is split in place of the record.

    Leave one group out: the records of group k are held out in fold k; all others train whole.

    Raises:
        UserError: when a fold has nothing to train on or an output is constant in it
    """
    least = 1 if rule.folds.kind == "tail" else 2
    if rule.folds.count < least:
        raise UserError(
            f"protocol.folds.count is {rule.folds.count}: at least {least} folds are needed"
        )
    found = splits([r.name for r in records], [len(r) for r in records], rule)
    for part in (part for split in found for part in split.held_out):
        if len(part.samples) < least_case(rule):
            record = records[part.record]
            raise UserError(
                f"record '{record.name}': {len(record)} samples are too few for "
                f"{rule.folds.count} folds after a past window of {rule.past}"
            )
    return tuple(_fold(records, split, rule, k) for k, split in enumerate(found))


def inner_folds(folds: Sequence[Fold], rule: ProtocolRule) -> tuple[Fold, ...]:
    """Folds within the training records of each fold, on which variants of a candidate are
    compared: each holds out a third of a fold's training records. The thirds rotate from fold to
    fold; with fewer than three folds, one of them holds out several in turn.

    A third is every third record where a fold has at least three, else a third of each record.
    They are numbered on from the folds, so that a fit on them has a seed of its own.

    Raises:
        UserError: where the records are too short to be divided, or an output does not move in a
            part
    """
    found: list[Fold] = []
    for fold in folds:
        for b, cut_at in enumerate(_cuts(fold, rule, _THIRDS)):
            if b % len(folds) == fold.index % _THIRDS:
                found.append(_fold(fold.train, cut_at, rule, len(folds) + len(found)))
    if not all(one.held_out for one in found):
        raise UserError("the training records of a fold are too short to hold out a third of them")
    return tuple(found)


def _cuts(fold: Fold, rule: ProtocolRule, count: int) -> Sequence[FoldCut]:
    """Cuts of a fold's training records, each of which holds out one of `count` parts."""
    lengths = [len(r) for r in fold.train]
    if len(lengths) < count:
        parts = replace(rule, folds=FoldRule("contiguous", count, gap=rule.folds.gap))
        return splits([r.name for r in fold.train], lengths, parts)
    blocks = [Excerpt(i, range(rule.past, length)) for i, length in enumerate(lengths)]
    wholes = [Excerpt(i, range(length)) for i, length in enumerate(lengths)]
    return [
        FoldCut(tuple(blocks[b::count]), tuple(w for w in wholes if w.record % count != b))
        for b in range(count)
    ]


def _fold(records: Sequence[Trajectory], split: FoldCut, rule: ProtocolRule, k: int) -> Fold:
    # Parts in which an output was never measured train nothing.
    parts = [
        p
        for p in split.train
        if records[p.record].measured[p.samples.start : p.samples.stop].any(axis=0).all()
    ]
    train = tuple(records[p.record].alone(p.samples.start, p.samples.stop) for p in parts)
    held_out = _blocks(records, split.held_out, rule)
    if held_out:
        never = np.isnan(np.concatenate([b.y for b in held_out])).all(axis=0)
        if never.any():
            raise UserError(
                f"output {int(np.argmax(never)) + 1} is never measured in what fold {k + 1} "
                "holds out: leave the output out or use fewer folds"
            )
    last = {p.record: p.samples.stop for p in parts}
    followed = tuple(last.get(block.record, 0) > block.stop for block in held_out)
    offsets = tuple(p.samples.start for p in parts)
    return Fold(k, train, held_out, _scale(train, rule, k), followed, offsets)


def _after_first_outputs(
    records: Sequence[Trajectory], part: Excerpt, rule: ProtocolRule
) -> Excerpt:
    """Skip the start of an excerpt until all samples of a past window were measured.

    This start lies within the first quarter of the excerpt. Without such a start, three quarters or
    half of the samples suffice; without that, each output must have been measured before. A past
    window of filled outputs is a bad initial state for any model, so that V would measure the gaps.
    """
    missing = records[part.record].missing
    if missing is None or not rule.past_outputs:
        return part
    first = max(part.samples.start, int(missing.argmin(axis=0).max()) + 1)
    counts = np.concatenate([np.zeros((1, missing.shape[1])), np.cumsum(~missing, axis=0)])
    places = np.arange(first, part.samples.start + (len(part.samples) + 1) // 2)
    shown = counts[places] - counts[np.maximum(places - rule.past_outputs, 0)]
    # Share of a past window that was measured, and the part of a block in which to look for it.
    for share, within in ((1.0, 0.25), (0.75, 0.25), (0.5, 0.5)):
        near = places < part.samples.start + within * len(part.samples)
        enough = near & (shown >= share * rule.past_outputs).all(axis=1)
        if enough.any():
            return Excerpt(part.record, range(int(places[np.argmax(enough)]), part.samples.stop))
    return Excerpt(part.record, range(first, part.samples.stop))


def _blocks(
    records: Sequence[Trajectory], parts: Sequence[Excerpt], rule: ProtocolRule
) -> tuple[Segment, ...]:
    return tuple(
        cut(records[part.record], window.start, window.stop, rule, part.record)
        for part in parts
        for window in windows(_after_first_outputs(records, part, rule).samples, rule)
    )


def _scale(train: Sequence[Trajectory], rule: ProtocolRule, index: int) -> Array:
    if not train:
        raise UserError(f"fold {index + 1} has no training record longer than the past window")
    if rule.tolerance is not None:
        return np.array(rule.tolerance)
    windowed = rule.horizon is not None
    y = np.concatenate(
        [b.y for b in whole(train, rule)] if windowed else [t.measured_y for t in train]
    )
    moves = np.nanmax(y, axis=0) - np.nanmin(y, axis=0) > LEAST_RANGE
    if not moves.all():
        channel = int(np.argmin(moves)) + 1
        raise UserError(
            f"output {channel} is constant over the training samples of fold {index + 1}: "
            "its error cannot be normalised; leave the channel out or use fewer folds"
        )
    return spread_of(y)


def fold_names(folds: Sequence[Fold], rule: ProtocolRule) -> tuple[str, ...]:
    """Name the held-out samples of each fold, for example `chirp: 8 records` or `block 1 of 2:
    samples 6 to 515 of run1`; samples are counted from 1."""
    if rule.folds.kind == "leave_one_group_out":
        counts = [
            f"record {g.records[0]}" if len(g.records) == 1 else f"{len(g.records)} records"
            for g in rule.folds.groups
        ]
        pairs = zip(rule.folds.groups, counts, strict=True)
        return tuple(f"{group.name}: {count}" for group, count in pairs)
    names: list[str] = []
    for fold in folds:
        blocks = fold.held_out
        records = {block.record for block in blocks}
        if len(records) > 1:
            where = f"of each of {len(records)} records"
        else:
            first, last = min(b.start for b in blocks) + 1, max(b.stop for b in blocks)
            where = f"samples {first} to {last} of {blocks[0].name}"
            if rule.folds.period is not None:
                where += f", the same {len(blocks[0].y)} of every {rule.folds.period}"
        names.append(f"block {fold.index + 1} of {len(folds)}: {where}")
    return tuple(names)
