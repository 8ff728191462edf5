"""Linear systems fitted to time records and measured frequency responses together.

Each set counts with the inverse of its residual variance, which is estimated in turn with the
system: the maximum of the likelihood with unknown variances. Source: Pintelon and Schoukens, System
Identification: A Frequency Domain Approach, 2nd ed., section 9.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from asia.candidate import Context
from asia.data.frequency import ComplexArray
from asia.data.trajectory import Array
from asia.models._linear.fit import LinearFit, Refinement, refine
from asia.models._linear.response import DrivenRecords
from asia.models._linear.system import LinearSystem
from asia.models._numerics.scaling import Scaling
from asia.models._numerics.training_records import ScaledData
from asia.models._reuse import reused
from asia.models.frequency_response import (
    fit_frequency_response,
    response_slopes,
    response_starts,
    response_weight,
    sampled_response,
)

_ROUNDS = 3
# Mean squared error, in z-scores, that counts as none.
_EXACT = 1e-12


@dataclass(frozen=True)
class SampledResponse:
    """Measured response of the sampled system, for z-scored signals."""

    z: ComplexArray  # (F,), points of the unit circle
    response: ComplexArray  # (F, ny, nu)
    weight: Array  # (F, ny, nu), of the real and imaginary parts
    least: float  # Mean squared weighted error of a perfect system: 1 where the variance is known
    order: int  # Of a model of this response alone
    delay: int  # Whole samples of its delay

    def delayed(self, samples: int) -> SampledResponse:
        """Leave out a delay of the inputs."""
        return replace(self, response=self.response * self.z[:, None, None] ** samples)

    def error(self, system: LinearSystem) -> float:
        """Mean squared weighted error of a system."""
        return float(np.mean(np.abs(self._weighted_error(system)) ** 2))

    def normal_equations(self, system: LinearSystem) -> tuple[Array, Array]:
        """Products of the derivatives by A, B, C and D with themselves and with the residuals."""
        apart = self._weighted_error(system).ravel()
        slopes = response_slopes(system.a, system.b, system.c, self.z)
        slopes = (self.weight[..., None] * slopes).reshape(len(apart), -1)
        return np.real(slopes.conj().T @ slopes), np.real(slopes.conj().T @ apart)

    def _weighted_error(self, system: LinearSystem) -> ComplexArray:
        """Weighted difference from a system (F, ny, nu)."""
        return self.weight * (self.response - system.response(self.z))


def sampled_responses(context: Context, scaling: Scaling) -> list[SampledResponse]:
    """Return the measured responses of a context for z-scored signals."""
    found: list[SampledResponse] = []
    size = scaling.u_std / scaling.y_std[:, None]
    for record in context.responses:
        fit = reused(
            "response",
            (record,),
            lambda _, record=record: fit_frequency_response(record),
            context.log,
        )
        sampled = sampled_response(fit, context.sampling_time)
        z = np.exp(2j * np.pi * sampled.frequency * context.sampling_time)
        found.append(
            SampledResponse(
                z, size * sampled.response, response_weight(sampled) / size,
                _EXACT if record.variance is None else 1.0, fit.model.order,
                int(fit.delay / context.sampling_time + 1e-6),
            )
        )  # fmt: skip
    return found


def fit_jointly(
    records: ScaledData,
    responses: Sequence[SampledResponse],
    start: LinearFit,
    refinement: Refinement,
) -> tuple[LinearFit, float]:
    """Refine a system for records and responses together, from a fit to the records and from the
    responses.

    Args:
        records, responses: without the delay of the inputs

    Returns:
        the fit, and minus twice its logarithmic likelihood but for a constant
    """
    n, nothing = start.system.order, np.zeros((len(records), start.system.order))
    starts = [start]
    for one in responses if not refinement.integrators else ():
        for matrices in response_starts(one.z, one.response, one.weight, n)[:1]:
            system = LinearSystem(*matrices, np.zeros(len(matrices[2])))
            error = DrivenRecords(records).response(system, nothing).error
            starts.append(LinearFit(system, nothing, error))
    found = [_refined(records, responses, one, refinement) for one in starts]
    return min(found, key=lambda pair: pair[1])


def _refined(
    records: ScaledData,
    responses: Sequence[SampledResponse],
    found: LinearFit,
    refinement: Refinement,
) -> tuple[LinearFit, float]:
    samples = sum(float((r.weight**2).sum()) for r in records)

    def errors(fit: LinearFit) -> list[float]:
        return [max(one.error(fit.system), one.least) for one in responses]

    for _ in range(_ROUNDS):
        if not math.isfinite(found.error):
            break
        time = max(found.error, _EXACT)
        # Twice: the variance of a response is that of both its parts.
        weighted = [
            replace(one, weight=math.sqrt(2.0 * time / error) * one.weight)
            for one, error in zip(responses, errors(found), strict=True)
        ]
        found = refine(records, found, refinement, responses=weighted)
    if not math.isfinite(found.error):
        return found, math.inf
    counts = [2.0 * one.response.size for one in responses]
    value = samples * math.log(max(found.error, _EXACT))
    value += sum(n * math.log(e) for n, e in zip(counts, errors(found), strict=True))
    return found, value
