"""Probes of a model beyond its held-out samples: small steps, a long run, later starts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from asia.data import Array, Trajectory, filled
from asia.errors import CandidateError
from asia.protocol import Block, Case
from asia.scoring.dossier import HORIZONS, SMALL, LinearResponse, impulse_response

Simulator = Callable[[Sequence[Block]], Sequence[Array]]

_POINTS = {"low inputs": 0.25, "middle inputs": 0.5, "high inputs": 0.75}
_SETTLING, _MOST_INPUTS, _LONGEST = 300, 4, 2000
_STARTS, _AHEAD = 24, 50


@dataclass(frozen=True)
class ProbeRange:
    """Ranges and records of the training data for probes."""

    records: tuple[Trajectory, ...]
    """All training records."""
    past_inputs: int
    """Samples of a past window."""
    past_outputs: int
    """Samples of a past window."""

    def block(self, u: Array, y: Array | None = None) -> Block:
        """Inputs (past + H, nu) as a block that starts from the mean output, or from y (past,
        ny)."""
        past = max(self.past_inputs, self.past_outputs)
        ny = self.records[0].y.shape[1]
        mean = np.concatenate([r.y for r in self.records]).mean(axis=0)
        past_y = (
            np.tile(mean, (self.past_outputs, 1)) if y is None else y[past - self.past_outputs :]
        )
        case = Case("", u[past - self.past_inputs : past], past_y, u[past:])
        # All of one record: a request then holds one block, whatever its length.
        return Block(case, np.zeros((len(u) - past, ny)), 0, 0)


def linear_responses(
    given: ProbeRange, names: Sequence[str], simulate: Simulator
) -> tuple[LinearResponse, ...]:
    """Small steps up and down of each input, after the inputs were held at an operating point;
    () where the model has no finite answer."""
    inputs = np.concatenate([r.u for r in given.records])
    deviation, past = inputs.std(axis=0), max(given.past_inputs, given.past_outputs)
    asked = [
        (point, number)
        for point in _POINTS
        for number in range(min(len(names), _MOST_INPUTS))
        if deviation[number] > 0.0
    ]
    blocks: list[Block] = []
    for point, number in asked:
        held = np.tile(np.quantile(inputs, _POINTS[point], axis=0), (past + 2 * _SETTLING, 1))
        for sign in (1.0, -1.0):
            moved = held.copy()
            moved[past + _SETTLING :, number] += sign * SMALL * deviation[number]
            blocks.append(given.block(moved))
    try:
        found = simulate(blocks)
    except CandidateError:
        return ()
    answers: list[LinearResponse] = []
    for place, (point, number) in enumerate(asked):
        up, down = (found[2 * place + k][_SETTLING:] for k in (0, 1))
        impulse = impulse_response(up, down, SMALL * float(deviation[number]))
        answers.append(LinearResponse(point, names[number], impulse))
    return tuple(answers)


def long_run(given: ProbeRange, horizon: int | None, simulate: Simulator) -> Array | None:
    """Ten horizons (n, ny) with the inputs of the longest record again and again; None where the
    model has no finite answer."""
    record = max(given.records, key=len)
    past = max(given.past_inputs, given.past_outputs)
    length = HORIZONS * min(_LONGEST, horizon or len(record))
    u = np.tile(record.u[past:], (-(-length // (len(record) - past)), 1))[:length]
    block = given.block(np.concatenate([record.u[:past], u]), record.y[:past])
    try:
        return simulate([block])[0]
    except CandidateError:
        return None


def starts(given: ProbeRange, blocks: Sequence[Block]) -> list[Block]:
    """Short blocks inside long ones, which begin from measured samples; [] where there is no past
    window, or no room."""
    past = max(given.past_inputs, given.past_outputs)
    long = [b for b in blocks if len(b.y) >= 2 * past + 2 * _AHEAD]
    if past == 0 or not long:
        return []
    each = max(1, _STARTS // len(long))
    found: list[Block] = []
    for block in long:
        y = filled(block.y)
        for at in np.linspace(past, len(block.y) - _AHEAD, each).astype(int).tolist():
            case = replace(
                block.case,
                past_u=block.case.u[at - given.past_inputs : at],
                past_y=y[at - given.past_outputs : at],
                u=block.case.u[at : at + _AHEAD],
            )
            ahead = block.y[at : at + _AHEAD]
            if not np.isnan(ahead).all(axis=0).any():
                found.append(Block(case, ahead, 0, block.start + at))
    return found
