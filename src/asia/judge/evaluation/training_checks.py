"""Checks of `asia validate` on the training records of a fold, as evidence for agents.

They run at every evaluation, so they use few samples and the worst outputs only.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from asia.candidate import Context
from asia.data.segment import Segment
from asia.data.trajectory import Array, filled
from asia.judge.evaluation.requests import spread
from asia.judge.scoring.checks.check import RecordedCheck, Verdict
from asia.judge.scoring.checks.residual import residual_checks
from asia.judge.scoring.checks.response import check_frequency_response, check_gain
from asia.judge.scoring.checks.validation_data import SimulatedSegments, without_responses

_MOST_SAMPLES, _MOST_OUTPUTS, _MOST_INPUTS = 2000, 2, 4
_FEWEST_SAMPLES = 200


def training_checks(
    blocks: Sequence[Segment], y_hat: Sequence[Array], scale: Array, context: Context
) -> tuple[RecordedCheck, ...]:
    """Run the checks and return those that do not pass, the most important first.

    Checks that need further simulations are left out. () for records that are too short.

    Args:
        y_hat: (H, ny) a block
    """
    # Blocks evenly spread, each from its start, as many as fit.
    longest = max(len(y) for y in y_hat)
    many = max(1, min(len(blocks), _MOST_SAMPLES // longest))
    each = _MOST_SAMPLES // many
    chosen = [(b, y[:each]) for b, y in spread(list(zip(blocks, y_hat, strict=True)), many)]
    if sum(len(y) for _, y in chosen) < _FEWEST_SAMPLES:
        return ()
    errors = np.concatenate([filled(b.y[: len(y)] - y) for b, y in chosen]) / scale
    worst = np.argsort(-np.mean(errors**2, axis=0), kind="stable")[:_MOST_OUTPUTS]
    outputs = sorted(worst.tolist())
    inputs = list(range(min(_MOST_INPUTS, len(context.inputs))))
    found = SimulatedSegments(
        tuple(
            replace(b, u=b.u[: len(y), inputs], y=b.y[: len(y), outputs]).simulated(y[:, outputs])
            for b, y in chosen
        ),
        tuple(context.inputs[k].name for k in inputs),
        tuple(context.outputs[k].name for k in outputs),
        context.sampling_time,
    )  # fmt: skip
    data = without_responses(found)
    checks = (*residual_checks(data), check_gain(data), check_frequency_response(data))
    raised = [c for c in checks if c.verdict in (Verdict.DOUBT, Verdict.FAIL)]
    raised.sort(key=lambda c: -c.weight)
    return tuple(
        RecordedCheck(c.name, c.verdict, c.sentence, weight=round(c.weight, 4)) for c in raised
    )
