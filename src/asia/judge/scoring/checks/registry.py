"""The validation checks by name: the built-in ones and those of installed packages."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias, cast

from asia._plugins import parts_of
from asia.data.trajectory import Array
from asia.errors import UserError
from asia.judge.scoring.checks.check import Check
from asia.judge.scoring.checks.records import SimulatedBlocks
from asia.judge.scoring.checks.residual import residual_checks
from asia.judge.scoring.checks.response import (
    LinearResponse,
    check_frequency_response,
    check_gain,
    check_long_run,
    check_responses,
    check_spectrum,
)

_GROUP = "asia.validation_checks"


@dataclass(frozen=True)
class ValidationData:
    """Simulations and responses of the model that is validated."""

    simulations: SimulatedBlocks
    """Measured and simulated outputs of samples that the model was not fitted to."""
    linear_responses: tuple[LinearResponse, ...]
    """Responses to small steps of each input; () where the model has no finite one."""
    lowest: Array
    """Least value of each output in the training records (ny,)."""
    highest: Array
    """Greatest value of each output in the training records (ny,)."""
    noise: Callable[[], Sequence[float | None]]
    """Estimate the noise of each output over its standard deviation, None where it is unknown."""
    long_run: Callable[[], Array | None]
    """Simulate ten horizons (n, ny) with repeated inputs; None where the model has no finite
    answer."""


ValidationCheck: TypeAlias = Callable[[ValidationData], "Check | tuple[Check, ...]"]
"""One check of a model, or several that share their computations.

Conformance suite: `asia.testing.check_validation_check`.
"""

VALIDATION_CHECKS: dict[str, ValidationCheck] = {
    "residuals": lambda data: residual_checks(data.simulations),
    "direction of gain": lambda data: check_gain(data.simulations),
    "error spectrum": lambda data: check_spectrum(data.simulations, data.noise()),
    "frequency response": lambda data: check_frequency_response(
        data.simulations, data.linear_responses
    ),
    "poles and static gain": lambda data: check_responses(
        data.linear_responses, data.simulations.outputs, data.simulations.sampling_time
    ),
    "ten horizons": lambda data: check_long_run(data.long_run(), data.lowest, data.highest),
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
