"""Which samples train, which are simulated, and from which past window."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from asia.errors import UserError
from asia.problem import Array, ProtocolRule, Trajectory
from asia.problem._blocks import blocks, rests


@dataclass(frozen=True)
class Case:
    """One thing to simulate: past_u (n_past_u, nu), past_y (n_past_y, ny), u (H, nu).

    Holds no output after the past window, so it can be handed to a candidate.
    """

    name: str
    past_u: Array
    past_y: Array
    u: Array


@dataclass(frozen=True)
class Block:
    """A case with what the evaluator keeps: the measured outputs y (H, ny), and where they lie
    in the record (`start`, 0-based)."""

    case: Case
    y: Array
    record: int
    start: int

    @property
    def stop(self) -> int:
        """One past the last sample, 0-based."""
        return self.start + len(self.y)


@dataclass(frozen=True)
class Fold:
    """Training records and held-out blocks of one fold; `scale` (ny,) is the standard deviation
    (ddof 0) of each output over the training samples."""

    index: int
    train: tuple[Trajectory, ...]
    validation: tuple[Block, ...]
    scale: Array


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
        past_y=record.y[start - rule.past_outputs : start],
        u=record.u[start:stop],
    )
    return Block(case, record.y[start:stop], index, start)


def whole(records: Sequence[Trajectory], rule: ProtocolRule) -> tuple[Block, ...]:
    """Each record simulated from its first past window to its end."""
    return tuple(cut(r, rule.past, len(r), rule, i) for i, r in enumerate(records))


def make_folds(records: Sequence[Trajectory], rule: ProtocolRule) -> tuple[Fold, ...]:
    """Contiguous folds: each record is split by `array_split` after its first past window.

    Block k of every record is held out in fold k; what lies before and after it trains, as records
    of their own. A training record too short to hold its own past window and one sample is left
    out. Raises UserError when a fold has nothing to train on or an output does not move in it.
    """
    if rule.folds.count < 2:
        raise UserError(f"protocol.folds.count is {rule.folds.count}: at least 2 folds are needed")
    pieces = [blocks(len(record), rule) for record in records]
    folds: list[Fold] = []
    for k in range(rule.folds.count):
        train: list[Trajectory] = []
        held_out: list[Block] = []
        for index, (record, parts) in enumerate(zip(records, pieces, strict=True)):
            if any(len(part) == 0 for part in parts):
                raise UserError(
                    f"record '{record.name}': {len(record)} samples are too few for "
                    f"{rule.folds.count} folds after a past window of {rule.past}"
                )
            block = parts[k]
            held_out.append(cut(record, block.start, block.stop, rule, index))
            train += [record[r.start : r.stop] for r in rests(len(record), block, rule)]
        folds.append(Fold(k, tuple(train), tuple(held_out), _scale(train, k)))
    return tuple(folds)


def _scale(train: Sequence[Trajectory], index: int) -> Array:
    if not train:
        raise UserError(f"fold {index + 1} has no training record longer than the past window")
    y = np.concatenate([t.y for t in train])
    moves = y.max(axis=0) > y.min(axis=0)
    if not moves.all():
        channel = int(np.argmin(moves)) + 1
        raise UserError(
            f"output {channel} is constant over the training samples of fold {index + 1}: "
            "its error cannot be normalised; leave the channel out or use fewer folds"
        )
    return y.std(axis=0)
