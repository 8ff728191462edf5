"""Where contiguous folds cut a record, in 0-based samples."""

from __future__ import annotations

from itertools import pairwise

from asia.problem._types import ProtocolRule


def blocks(length: int, rule: ProtocolRule) -> list[range]:
    """The held-out block of each fold: what lies after the first past window in `folds.count`
    parts, the first ones a sample longer when it does not divide; empty ones when too short."""
    size, longer = divmod(max(length - rule.past, 0), rule.folds.count)
    edges = [rule.past + k * size + min(k, longer) for k in range(rule.folds.count + 1)]
    return [range(start, stop) for start, stop in pairwise(edges)]


def rests(length: int, block: range, rule: ProtocolRule) -> list[range]:
    """What trains while `block` is held out: the samples before and after it, as far as they hold
    a past window of their own and one sample more."""
    parts = range(rule.past, block.start), range(block.stop, length)
    return [part for part in parts if len(part) > rule.past]
