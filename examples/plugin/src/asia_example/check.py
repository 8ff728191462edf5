"""A validation check: the mean error of each output."""

from __future__ import annotations

import numpy as np

from asia.judge.scoring.checks.check import Check, Verdict
from asia.judge.scoring.checks.validation_data import ValidationData

_LARGEST = 0.1


def check_offset(data: ValidationData) -> Check:
    """Compare the mean error of each output with the standard deviation of the output."""
    found = data.simulations
    residuals = np.concatenate([block.residual for block in found.blocks])
    share = float(np.max(np.abs(residuals.mean(axis=0)) / found.deviation))
    sentence = f"the mean error is at most {100 * share:.2g} % of the deviation of an output"
    if share > _LARGEST:
        return Check("offset", Verdict.DOUBT, sentence, weight=share**2)
    return Check("offset", Verdict.PASS, sentence)
