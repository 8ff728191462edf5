"""Validation report: the checks of a model before its use.

Every check is a function of arrays: measured and simulated outputs, or answers of a simulator. A
residual is judged by the share that regressors explain significantly, corrected for its own
correlation, and only where that share is large enough to matter.
"""

from asia.scoring.dossier.ahead import check_ahead, no_steps_ahead
from asia.scoring.dossier.banded import check_bands, no_bands
from asia.scoring.dossier.check import Cause, Check, CheckCurve, Verdict, most_serious, summary
from asia.scoring.dossier.gain import check_gain
from asia.scoring.dossier.long_run import HORIZONS, check_long_run
from asia.scoring.dossier.overfit import check_overfit
from asia.scoring.dossier.records import SimulatedBlock, SimulatedBlocks
from asia.scoring.dossier.region import check_region
from asia.scoring.dossier.registry import (
    VALIDATION_CHECKS,
    ValidationCheck,
    ValidationData,
    validation_checks,
)
from asia.scoring.dossier.residual import residual_checks
from asia.scoring.dossier.response import (
    SMALL,
    LinearResponse,
    check_responses,
    frequency_response_of,
    impulse_response,
    poles,
)
from asia.scoring.dossier.spectrum import check_frequency_response, check_spectrum

__all__ = [
    "HORIZONS",
    "SMALL",
    "VALIDATION_CHECKS",
    "Cause",
    "Check",
    "CheckCurve",
    "LinearResponse",
    "SimulatedBlock",
    "SimulatedBlocks",
    "ValidationCheck",
    "ValidationData",
    "Verdict",
    "check_ahead",
    "check_bands",
    "check_frequency_response",
    "check_gain",
    "check_long_run",
    "check_overfit",
    "check_region",
    "check_responses",
    "check_spectrum",
    "frequency_response_of",
    "impulse_response",
    "most_serious",
    "no_bands",
    "no_steps_ahead",
    "poles",
    "residual_checks",
    "summary",
    "validation_checks",
]
