"""Guard records that are cut from the training records."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from asia.data.preprocess import Preprocess
from asia.data.trajectory import Array, Trajectory
from asia.problem.folds import least_case
from asia.problem.protocol import ProtocolRule

GUARD_SHARE = 0.15
"""Share of the training records that is held back where an agent can read the rest."""
WHOLE_RECORDS = 7
"""Training records from which on whole ones are held back."""


class Division(NamedTuple):
    """Samples of each record that train; the others are held back."""

    lengths: tuple[int, ...]
    """Training samples of each record; 0 where the whole record is held back."""

    def train(self, records: Sequence[Trajectory]) -> tuple[Trajectory, ...]:
        """Return the parts that train."""
        return tuple(r.alone(0, n) for r, n in zip(records, self.lengths, strict=True) if n)

    def truth(self, outputs: Sequence[Array]) -> tuple[Array, ...]:
        """Return the same parts of noise-free outputs."""
        return tuple(y[:n] for y, n in zip(outputs, self.lengths, strict=True) if n)

    def guard(self, records: Sequence[Trajectory]) -> tuple[Trajectory, ...]:
        """Return the parts that are held back."""
        pairs = zip(records, self.lengths, strict=True)
        return tuple(r.alone(n, len(r)) for r, n in pairs if n < len(r))


def divided(
    records: Sequence[Trajectory], share: float, rule: ProtocolRule, preprocess: Preprocess
) -> Division:
    """Hold back a share of the records: of seven or more the last ones, else the end of each.

    A record whose end is too short for one case trains as a whole. Where folds name their records,
    the end of each is held back.

    Args:
        records: training records as they were read.
        share: share that is held back, from 0 to 1.
    """
    least = (rule.past + least_case(rule)) * preprocess.decimate
    whole = rule.folds.kind != "leave_one_group_out"
    lengths = [len(record) for record in records]
    if whole and len(records) >= WHOLE_RECORDS:
        count = max(round(share * len(records)), 1)
        return Division((*lengths[:-count], *[0] * count))
    ends = [round(share * n) for n in lengths]
    return Division(
        tuple(n - end if end >= least else n for n, end in zip(lengths, ends, strict=True))
    )
