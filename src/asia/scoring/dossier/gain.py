"""Check of the sign of the gain from each input."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from asia.data import Array
from asia.scoring.dossier.check import Cause, Check, Verdict
from asia.scoring.dossier.records import SimulatedBlocks
from asia.scoring.dossier.regressors import groups

# An input's part of the output, over the output's deviation, below which its sign is not judged.
_LEAST_PART = 0.15
_AGAINST = -0.3


@dataclass(frozen=True)
class _Direction:
    """One input's part of one output, measured and simulated."""

    names: tuple[str, str]
    """Input, output."""
    agreement: float
    """Correlation of the two parts."""


def check_gain(found: SimulatedBlocks) -> Check:
    """The part of each output that the past of an input explains, in the data and in the
    simulation: the two must not point in opposite directions."""
    judged: list[_Direction] = []
    for output in range(len(found.outputs)):
        judged += _directions(found, output)
    if not judged:
        return Check("direction of gain", Verdict.SHOWN, "no single input affects an output "
                     "enough to "
                     "judge the direction of its gain")  # fmt: skip
    worst = min(judged, key=lambda d: d.agreement)
    name, output = worst.names
    if worst.agreement >= _AGAINST:
        sentence = (
            f"the gain of every input has the sign of the data (least correlation "
            f"{worst.agreement:.2f}, {name} on {output})"
        )
        return Check("direction of gain", Verdict.PASS, sentence)
    sentence = (
        f"the gain from {name} to {output} has the opposite sign of the data "
        f"(correlation {worst.agreement:.2f}): {Cause.SIGN}"
    )
    return Check("direction of gain", Verdict.FAIL, sentence, Cause.SIGN, 2.0)


def _directions(found: SimulatedBlocks, output: int) -> list[_Direction]:
    columns = groups(found, output)
    reach, inputs = columns.reach, len(found.inputs)
    x = np.concatenate(columns.inputs)
    centre = x.mean(axis=0)
    measured = np.concatenate([b.complete_y[reach:, output] for b in found.blocks])
    simulated = np.concatenate([b.y_hat[reach:, output] for b in found.blocks])
    fits = [_ridge(x - centre, y - y.mean()) for y in (measured, simulated)]
    parts: list[_Direction] = []
    for number in range(inputs):
        # The columns of one input: every `inputs`-th.
        own = slice(number, None, inputs)
        data, model = ((x - centre)[:, own] @ fit[own] for fit in fits)
        sizes = data.std() / max(measured.std(), 1e-300), model.std() / max(simulated.std(), 1e-300)
        if min(sizes) < _LEAST_PART:
            continue
        agreement = float(np.mean(data * model) / (data.std() * model.std()))
        parts.append(_Direction((found.inputs[number], found.outputs[output]), agreement))
    return parts


def _ridge(x: Array, y: Array) -> Array:
    size = x.std(axis=0)
    size[size == 0.0] = 1.0
    z = x / size
    gram = z.T @ z
    return np.linalg.solve(gram + 1e-4 * len(z) * np.eye(len(gram)), z.T @ y) / size
