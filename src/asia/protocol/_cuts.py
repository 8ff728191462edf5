"""Cut points of folds and windows in records, in 0-based samples."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

from asia.protocol._rules import ProtocolRule


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
    records = range(len(names))
    if rule.folds.kind == "leave_one_group_out":
        return [
            FoldCut(
                tuple(
                    Excerpt(i, range(rule.past, lengths[i]))
                    for i in records
                    if names[i] in group.records
                ),
                tuple(
                    Excerpt(i, range(lengths[i])) for i in records if names[i] not in group.records
                ),
            )
            for group in rule.folds.groups
        ]
    cuts = [blocks(length, rule) for length in lengths]
    return [
        FoldCut(
            tuple(Excerpt(i, cuts[i][k]) for i in records),
            tuple(
                Excerpt(i, rest) for i in records for rest in rests(lengths[i], cuts[i][k], rule)
            ),
        )
        for k in range(rule.folds.count)
    ]


def blocks(length: int, rule: ProtocolRule) -> list[range]:
    """Return the held-out block of each fold, empty where the record is too short.

    The samples after the first past window (in tail folds: the tail) are split into `block_count`
    parts; the first parts are one sample longer when the length does not divide. In forward folds
    the first part trains only.
    """
    count = block_count(rule)
    start = rule.past
    if rule.folds.tail is not None:
        start = max(start, length - rule.folds.tail)
    size, longer = divmod(max(length - start, 0), count)
    edges = [start + k * size + min(k, longer) for k in range(count + 1)]
    return [range(start, stop) for start, stop in pairwise(edges)][count - rule.folds.count :]


def block_count(rule: ProtocolRule) -> int:
    """Into how many blocks a record is cut."""
    return rule.folds.count + (rule.folds.kind == "forward")


def rests(length: int, block: range, rule: ProtocolRule) -> list[range]:
    """Return the samples that train while `block` is held out.

    These are the samples before the block and, except in forward and tail folds, after it, without
    the gap. A part is kept if it is long enough for its own past window and one more case.
    """
    gap = rule.folds.gap or 0
    parts = [range(rule.past, block.start - gap)]
    if rule.folds.kind == "contiguous":
        parts.append(range(block.stop + gap, length))
    return [part for part in parts if len(part) >= rule.past + least_case(rule)]


def least_case(rule: ProtocolRule) -> int:
    """Samples of the shortest case."""
    return rule.horizon if rule.horizon is not None else 1


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
