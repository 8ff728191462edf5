"""Training samples, simulated samples and past windows of each fold."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from asia.data import Array, Trajectory, filled, spread_of
from asia.data._magnitudes import LEAST_RANGE
from asia.errors import UserError
from asia.protocol._cuts import Excerpt, least_case, splits, windows
from asia.protocol._rules import ProtocolRule

# Share of a past window that was measured, and the part of a block in which that is looked for.
_STARTS = ((1.0, 0.25), (0.75, 0.25), (0.5, 0.5))


@dataclass(frozen=True)
class Case:
    """One thing to simulate. It holds no output after the past window, so that a candidate may
    have it."""

    name: str
    """Name of the record."""
    past_u: Array
    """Inputs of the past window (n_past_u, nu)."""
    past_y: Array
    """Outputs of the past window (n_past_y, ny)."""
    u: Array
    """Inputs of the samples to simulate (H, nu)."""


@dataclass(frozen=True)
class Block:
    """Case together with the outputs that the evaluator keeps."""

    case: Case
    """Data that a candidate receives."""
    y: Array
    """The measured outputs (H, ny), NaN where none was measured."""
    record: int
    """Number of the record among those that were cut, 0-based."""
    start: int
    """The first simulated sample in that record, 0-based."""

    @property
    def stop(self) -> int:
        """One past the last sample, 0-based."""
        return self.start + len(self.y)


@dataclass(frozen=True)
class Fold:
    """Training records and held-out blocks of one fold."""

    index: int
    """Number of the fold, 0-based."""
    train: tuple[Trajectory, ...]
    """Records that the models of this fold are fitted to."""
    validation: tuple[Block, ...]
    """Held-out blocks, those of each record in time order."""
    scale: Array
    """Standard deviation (ny,), ddof 0, of each output over the training samples; with a horizon
    over the concatenated training windows."""
    followed: tuple[bool, ...] = ()
    """For each held-out block, whether later samples of its record train."""
    offsets: tuple[int, ...] = ()
    """For each training record, its first sample in the record that it was cut from; () where each
    is a whole record."""


def cut(record: Trajectory, start: int, stop: int, rule: ProtocolRule, index: int = 0) -> Block:
    """The block `record[start:stop]` with the past windows just before it."""
    if start < rule.past:
        raise UserError(
            f"record '{record.name}': simulation cannot start at sample {start + 1}, "
            f"the past window needs {rule.past} samples before it"
        )
    case = Case(
        name=record.name,
        past_u=record.u[start - rule.past_inputs : start],
        past_y=_past_outputs(record, start, rule.past_outputs),
        u=record.u[start:stop],
    )
    return Block(case, record.measured_y[start:stop], index, start)


def _past_outputs(record: Trajectory, start: int, count: int) -> Array:
    """The `count` outputs before `start`.

    Where one was not measured it is filled from samples before `start` alone, so that none of those
    to simulate shows.

    Raises:
        UserError: where there is none
    """
    window = record.y[start - count : start]
    if record.missing is None or not record.missing[start - count : start].any():
        return window
    known = record.measured_y[:start]
    never = np.isnan(known).all(axis=0)
    if never.any():
        raise UserError(
            f"record '{record.name}': output {int(np.argmax(never)) + 1} is not measured before "
            f"sample {start + 1}, where a simulation starts from past outputs: cut the record so "
            "that it begins with a measured sample"
        )
    return filled(known)[start - count :]


def whole(records: Sequence[Trajectory], rule: ProtocolRule) -> tuple[Block, ...]:
    """Each record from its first past window to its end: one block, or one for each window.

    Windows follow each other every `horizon` samples; the last one ends with the record and may
    overlap its neighbour, so that N samples give ceil((N - past) / horizon) of them.
    """
    parts = [Excerpt(i, range(rule.past, len(r))) for i, r in enumerate(records)]
    return _blocks(records, parts, rule)


def make_folds(records: Sequence[Trajectory], rule: ProtocolRule) -> tuple[Fold, ...]:
    """Make the folds of a problem's training records.

    Contiguous: each record is split by `array_split` after its first past window. Block k of every
    record is held out in fold k; the samples before and after it train, as records of their own. A
    training record too short to hold its own past window and one case is left out.

    Forward: one part more; part k + 1 is held out in fold k, and the samples before it train. Tail:
    as forward, with all parts in the last `folds.tail` samples. The samples of `folds.gap` next to
    a held-out part train nothing.

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
    folds: list[Fold] = []
    for k, split in enumerate(found):
        parts = [part for part in split.train if _is_measured(records, part)]
        train = tuple(records[p.record].alone(p.samples.start, p.samples.stop) for p in parts)
        held_out = _blocks(records, split.held_out, rule)
        _check_measured(held_out, k)
        last = {p.record: p.samples.stop for p in parts}
        followed = tuple(last.get(block.record, 0) > block.stop for block in held_out)
        offsets = tuple(p.samples.start for p in parts)
        folds.append(Fold(k, train, held_out, _scale(train, rule, k), followed, offsets))
    return tuple(folds)


def _is_measured(records: Sequence[Trajectory], part: Excerpt) -> bool:
    """Return whether each output was measured in it at least once."""
    missing = records[part.record].missing
    own = slice(part.samples.start, part.samples.stop)
    return missing is None or not missing[own].all(axis=0).any()


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
    for share, within in _STARTS:
        near = places < part.samples.start + within * len(part.samples)
        enough = near & (shown >= share * rule.past_outputs).all(axis=1)
        if enough.any():
            return Excerpt(part.record, range(int(places[np.argmax(enough)]), part.samples.stop))
    return Excerpt(part.record, range(first, part.samples.stop))


def _check_measured(blocks: Sequence[Block], index: int) -> None:
    never = np.isnan(np.concatenate([b.y for b in blocks])).all(axis=0) if blocks else np.array([])
    if never.any():
        raise UserError(
            f"output {int(np.argmax(never)) + 1} is never measured in what fold {index + 1} holds "
            "out: leave the output out or use fewer folds"
        )


def _blocks(
    records: Sequence[Trajectory], parts: Sequence[Excerpt], rule: ProtocolRule
) -> tuple[Block, ...]:
    return tuple(
        cut(records[part.record], window.start, window.stop, rule, part.record)
        for part in parts
        for window in windows(_after_first_outputs(records, part, rule).samples, rule)
    )


def _scale(train: Sequence[Trajectory], rule: ProtocolRule, index: int) -> Array:
    if not train:
        raise UserError(f"fold {index + 1} has no training record longer than the past window")
    if rule.horizon is None:
        samples = [t.measured_y for t in train]
    else:
        samples = [b.y for b in whole(train, rule)]
    y = np.concatenate(samples)
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
        return tuple(
            f"{group.name}: {_counted(group.records)}"
            for group, _ in zip(rule.folds.groups, folds, strict=True)
        )
    return tuple(f"block {f.index + 1} of {len(folds)}: {_excerpts(f)}" for f in folds)


def _counted(records: Sequence[str]) -> str:
    return f"record {records[0]}" if len(records) == 1 else f"{len(records)} records"


def _excerpts(fold: Fold) -> str:
    """The held-out samples of one record, or of how many."""
    records = {block.record for block in fold.validation}
    if len(records) > 1:
        return f"of each of {len(records)} records"
    blocks = fold.validation
    first, last = min(b.start for b in blocks) + 1, max(b.stop for b in blocks)
    return f"samples {first} to {last} of {blocks[0].case.name}"
