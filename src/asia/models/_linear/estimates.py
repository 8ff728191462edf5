"""Estimates of the static gains and time constants of a linear model, with their uncertainty."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from asia.candidate import ParameterEstimate, ParameterEstimates
from asia.data import Array, Trajectory
from asia.models import uncertainty
from asia.models._data.records import ScaledTrajectory, refuse_gaps
from asia.models._data.scaling import Scaling
from asia.models._linear.long import LongResponse
from asia.models._linear.system import LinearSystem

# Greatest number of matrix entries: those of a larger model are no quantities of interest to users.
_MOST_ENTRIES = 150
# Greatest distance from the minimum in standard errors: a fit further away minimises another cost.
_NEAR = 0.5

# Least number of samples for a simulation by convolution.
_LONG = 65_536
_MOST_GAINS = 20
_MOST_TIME_CONSTANTS = 6


@dataclass(frozen=True)
class ScaledRecord:
    """Record in z-scores, the inputs delayed."""

    u: Array
    """(T, nu)."""
    y: Array
    """(T, ny)."""


def delayed_records(
    trajectories: Sequence[Trajectory], scaling: Scaling, delay: int
) -> list[ScaledRecord]:
    """Scale and delay records, without the samples whose delayed input was not measured.

    Raises:
        ValueError: if outputs were not measured.
    """
    refuse_gaps(trajectories)
    return [
        ScaledRecord(scaling.inputs(t.u)[: len(t) - delay], scaling.outputs(t.y)[delay:])
        for t in trajectories
    ]


def system_estimates(
    system: LinearSystem,
    records: Sequence[ScaledRecord],
    report: Callable[[LinearSystem], Sequence[ParameterEstimate]],
) -> ParameterEstimates:
    """Estimate the uncertainty of quantities of a system, whatever the coordinates of its states.

    Args:
        system: fitted system.
        records: records of the fit; the initial state of each is fitted with the system.
        report: computes the quantities from a system.

    Raises:
        ValueError: for a system of too many numbers, and if the simulation error of the records has
            no minimum at the system.
    """
    theta, shapes = _packed(system)
    if len(theta) > _MOST_ENTRIES:
        raise ValueError(f"{len(theta)} numbers: too many for standard errors; use a lower order")
    responses = [_free_response(system, len(record.u)) for record in records]
    starts = [
        _start(system, record, response)
        for record, response in zip(records, responses, strict=True)
    ]

    def residuals(theta: Array) -> list[Array]:
        other = _unpacked(theta, shapes)
        return [_errors(other, record, x0) for record, x0 in zip(records, starts, strict=True)]

    found, slopes = uncertainty.jacobians_of(residuals, theta)
    covariance = uncertainty.sandwich(found, slopes, nuisance=responses)
    _check_minimum(covariance, found, slopes, responses)
    return uncertainty.estimates(covariance, lambda x: report(_unpacked(x, shapes)), theta)


def _errors(system: LinearSystem, record: ScaledRecord, x0: Array) -> Array:
    """Simulated minus measured outputs (T, ny)."""
    samples = len(record.u)
    if samples <= _LONG:
        return system.simulate(x0[None], record.u[None])[1][0] - record.y
    every = np.broadcast_to(np.float64(1.0), samples)
    scaled = ScaledTrajectory(record.u, record.y, every, record.u, every)
    return -LongResponse([scaled], float(record.y.size), system, x0[None]).misfit(0)


def _check_minimum(
    covariance: uncertainty.Covariance,
    residuals: Sequence[Array],
    slopes: Sequence[Array],
    nuisance: Sequence[Array],
) -> None:
    step = -covariance.information @ uncertainty.gradient(residuals, slopes, nuisance)
    errors = np.sqrt(np.maximum(np.diagonal(covariance.matrix), 0.0))
    if np.any(np.abs(step) > _NEAR * errors + 1e-12):
        raise ValueError("the fit is no minimum of the simulation error of these records")


def _packed(system: LinearSystem) -> tuple[Array, list[tuple[int, ...]]]:
    parts = [system.a, system.b, system.c, system.d, system.offset]
    return np.concatenate([part.ravel() for part in parts]), [part.shape for part in parts]


def _unpacked(theta: Array, shapes: Sequence[tuple[int, ...]]) -> LinearSystem:
    ends = np.cumsum([0, *(int(np.prod(shape)) for shape in shapes)])
    parts = [
        theta[a:b].reshape(shape) for (a, b), shape in zip(pairwise(ends), shapes, strict=True)
    ]
    return LinearSystem(*parts)


def _free_response(system: LinearSystem, samples: int) -> Array:
    """Outputs (T, ny, n) to each initial state of length 1."""
    plain = LinearSystem(
        system.a, system.b, system.c, system.d, np.zeros_like(system.offset)
    )  # fmt: skip
    rest = np.zeros((system.order, samples, system.b.shape[1]))
    return plain.simulate(np.eye(system.order), rest)[1].transpose(1, 2, 0)


def _start(system: LinearSystem, record: ScaledRecord, response: Array) -> Array:
    """Initial state with the least simulation error."""
    forced = system.simulate(np.zeros((1, system.order)), record.u[None])[1][0]
    flat = response.reshape(-1, system.order)
    return np.linalg.lstsq(flat, (record.y - forced).ravel())[0]


def invariants(system: LinearSystem, scaling: Scaling) -> dict[str, float]:
    """Static gains in physical units and slowest time constants in samples, by name."""
    gain = system.gain * scaling.y_std[:, None] / scaling.u_std
    found = {f"gain y{i + 1}/u{j + 1}": float(g) for (i, j), g in np.ndenumerate(gain)}
    found = found if len(found) <= _MOST_GAINS else {}
    slowest = system.time_constants[:_MOST_TIME_CONSTANTS]
    return found | {f"time constant {k} [samples]": float(t) for k, t in enumerate(slowest, 1)}
