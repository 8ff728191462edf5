"""(y, y_hat) -> Score or Failure. Sees targets, never runs a candidate."""

from asia.scoring._attribution import Attribution, attribute, gain
from asia.scoring._bands import Bands, HeldOutErrors, output_bands
from asia.scoring._confirmation import (
    ExpectedError,
    Interval,
    RepeatedFits,
    block_values,
    corrected_level,
    expected_error,
    expected_lowest,
    expected_of_ensemble,
    noise_of_seeds,
    paired_difference,
    selection_optimism,
    value_interval,
)
from asia.scoring._correlation import (
    Correlation,
    cross_correlation,
    independent_band,
    white_band,
    with_input,
    with_own_past,
)
from asia.scoring._diagnostics import Diagnostics, diagnose
from asia.scoring._difference import least_significant_difference
from asia.scoring._fit import fit_index, r2
from asia.scoring._mee import GroupError, MeeTable, mee_table
from asia.scoring._outcome import (
    Failure,
    FoldScore,
    Outcome,
    Score,
    TestScore,
    check_reply,
    combine,
    score_fold,
    score_test,
)
from asia.scoring._signed import (
    Evidence,
    PartKind,
    Ranges,
    SignedResidual,
    evidence_of_mean,
    ranges_of,
    signed_residuals,
)
from asia.scoring._validity import Region, region_of

__all__ = [
    "Attribution",
    "Bands",
    "Correlation",
    "Diagnostics",
    "Evidence",
    "ExpectedError",
    "Failure",
    "FoldScore",
    "GroupError",
    "HeldOutErrors",
    "Interval",
    "MeeTable",
    "Outcome",
    "PartKind",
    "Ranges",
    "Region",
    "RepeatedFits",
    "Score",
    "SignedResidual",
    "TestScore",
    "attribute",
    "block_values",
    "check_reply",
    "combine",
    "corrected_level",
    "cross_correlation",
    "diagnose",
    "evidence_of_mean",
    "expected_error",
    "expected_lowest",
    "expected_of_ensemble",
    "fit_index",
    "gain",
    "independent_band",
    "least_significant_difference",
    "mee_table",
    "noise_of_seeds",
    "output_bands",
    "paired_difference",
    "r2",
    "ranges_of",
    "region_of",
    "score_fold",
    "score_test",
    "selection_optimism",
    "signed_residuals",
    "value_interval",
    "white_band",
    "with_input",
    "with_own_past",
]
