"""Estimates of the parameters of a trained grey-box, with their uncertainty."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from asia.candidate import ParameterEstimate, ParameterEstimates
from asia.data import Array
from asia.models import uncertainty
from asia.models._equations.config import GreyBoxStructure
from asia.models._equations.fit import FittedEquations
from asia.models._equations.simulation_error import SimulationError
from asia.models._equations.starts import RecordPieces, Starts
from asia.models._least_squares import TRIALS
from asia.models._noise.weighting import ErrorWeighting

if TYPE_CHECKING:
    from asia.models._equations.programs import CompiledSimulator


@dataclass(frozen=True)
class Around:
    """Trained grey-box with the records that it was fitted to."""

    structure: GreyBoxStructure
    """Structure of the fit."""
    fitted: FittedEquations
    """Result of the fit."""
    segments: RecordPieces
    """Records as the fit cut them."""
    values: Callable[[Array], dict[str, float]]
    """Named parameters at coordinates (size,)."""

    def estimates(self, equations: Sequence[str]) -> ParameterEstimates:
        """Estimate the uncertainty of the parameters.

        Args:
            equations: lines of the equations with the numbers put in.

        Raises:
            ValueError: if these are not the records of the fit.
        """
        # Import of JAX, which a trained model does not need.
        from asia.models._equations.programs import CompiledSimulator

        structure, segments = self.structure, self.segments
        if self.fitted.x0 is None or self.fitted.x0.shape != (len(segments.u), structure.nx):
            raise ValueError(
                "grey-box: estimates need the records that the model was fitted to, as many as then"
            )
        error = self._error(CompiledSimulator(structure, segments.u, TRIALS), self.fitted.x0)
        theta = error.theta0
        e, jacobian, nuisance = error.jacobians(theta)
        lengths = (self.segments.mask > 0).sum(axis=1)
        residuals, jacobians, own = (
            [part[:length] for part, length in zip(values, lengths, strict=True)]
            for values in (e, jacobian, nuisance)
        )
        held, known, weight = error.penalties(theta)
        covariance = uncertainty.sandwich(
            residuals,
            jacobians,
            held,
            own if nuisance.shape[-1] else None,
            uncertainty.PriorPenalty(known, weight),
        )
        return uncertainty.estimates(covariance, self._report, self.fitted.z, equations)

    def _error(self, simulate: CompiledSimulator, x0: Array) -> SimulationError:
        structure, segments, fitted = self.structure, self.segments, self.fitted
        shift = np.zeros((1, *x0.shape))
        starts = Starts(fitted.z[None], shift, x0[None], fitted.scales.for_rows())
        whiten = None
        if fitted.noise is not None:
            mask = segments.mask
            if structure.measured:
                mask = mask * (np.arange(mask.shape[1]) > 0)
            whiten = ErrorWeighting.of(fitted.noise, structure.sampling_time, mask, fitted.huber)
        active = np.ones(structure.layout.size)
        return SimulationError(structure, segments, starts, active, simulate, whiten)

    def _report(self, z: Array) -> list[ParameterEstimate]:
        ranges = dict(zip(self.structure.equations.parameters, self.structure.ranges, strict=False))
        learned = self.structure.learned
        above = {n for n, p in zip(learned.names, learned.positive, strict=True) if p}
        found: list[ParameterEstimate] = []
        for name, value in self.values(z).items():
            one = ParameterEstimate(name, value, math.nan, math.nan, math.nan)
            if name in ranges:
                one = replace(one, lower=ranges[name].min, upper=ranges[name].max)
            elif name in above:
                one = replace(one, lower=float(np.finfo(float).tiny))
            found.append(one)
        return found
