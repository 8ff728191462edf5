"""The validation checks by name: the built-in ones and those of installed packages."""

from __future__ import annotations

from typing import cast

from asia._plugins import parts_of
from asia.errors import UserError
from asia.judge.scoring.checks.residual import residual_checks
from asia.judge.scoring.checks.response import (
    check_frequency_response,
    check_gain,
    check_long_run,
    check_responses,
    check_spectrum,
)
from asia.judge.scoring.checks.validation_data import ValidationCheck

_GROUP = "asia.validation_checks"


VALIDATION_CHECKS: dict[str, ValidationCheck] = {
    "residuals": residual_checks,
    "direction of gain": check_gain,
    "error spectrum": check_spectrum,
    "frequency response": check_frequency_response,
    "poles and static gain": check_responses,
    "ten horizons": check_long_run,
}
"""The built-in checks, in the order to read them."""


def validation_checks() -> dict[str, ValidationCheck]:
    """All checks by name: the built-in ones, then those of installed packages. Raises UserError
    where an installed package brings a check that is taken by name or cannot be called."""
    found = dict(VALIDATION_CHECKS)
    for part in parts_of(_GROUP):
        package = f"validation check '{part.name}' of package {part.package} {part.version}"
        if part.name in VALIDATION_CHECKS:
            raise UserError(f"{package}: ASIA has a check of this name; rename the entry point")
        check = part.load()
        if not callable(check):
            raise UserError(f"{package} is {check!r}, expected a function of one ValidationData")
        found[part.name] = cast("ValidationCheck", check)
    return found
