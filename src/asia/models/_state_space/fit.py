"""Levenberg-Marquardt on the simulation error of a neural state-space model.

Fits go from several starts, and the noise is estimated between them.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np

from asia.candidate import Context
from asia.data.trajectory import Array
from asia.models._arrays import Packing, packed
from asia.models._config import Progress
from asia.models._least_squares import LevenbergMarquardt, Minimum, minimise
from asia.models._noise.model import (
    LEAST_DEVIATION,
    NOISE_ROUNDS,
    ErrorWeighting,
    NoiseChoice,
    estimate_noise,
    settled,
)
from asia.models._numerics.encoder import Encoder, window_encoder
from asia.models._numerics.training_records import ScaledData, past_length, side_by_side
from asia.models._state_space.model import ENCODER_UNITS
from asia.models._state_space.programs import (
    CompiledEquations,
    SampleChunks,
    StabilityTerm,
    StateSamples,
    Watch,
    chunked,
    spectral_radius,
)
from asia.models._state_space.structure import StateSpaceStructure


class StateFit(NamedTuple):
    """Fit from one start."""

    x0: Array  # Initial states (R, n)
    params: dict[str, Any]  # Parameters as the structure reads them
    cost: float  # Mean squared error and ridge
    history: Array  # Root of the cost by iteration


def of_records(records: ScaledData, x0: Array) -> StateSamples:
    """Stack whole records, their initial states to be found from x0 (R, n)."""
    u, y, weight = (
        side_by_side([getattr(r, name) for r in records]) for name in ("u", "y", "weight")
    )
    return StateSamples(x0, u, y, weight, known=False)


def fit_states(
    structure: StateSpaceStructure,
    starts: Sequence[dict[str, Any]],
    samples: StateSamples,
    ridge: dict[str, float],
    method: LevenbergMarquardt,
    log: Progress,
    sampling_time: float = 1.0,
    begin: Sequence[dict[str, Any]] | None = None,
    x0: Sequence[Array] | None = None,
    stability: StabilityTerm | None = None,
) -> list[StateFit]:
    """Fit from each start, the least cost first.

    With a noise model all fits are continued after each estimate from the best fit's residuals,
    with a third of the iterations. The log receives iteration and the root of the least cost so
    far, over all starts.

    Args:
        structure: equations of the model.
        starts: parameters that the ridge holds the fits to.
        samples: records or segments.
        ridge: ridge of each top-level parameter name and of "x0".
        method: settings.
        log: progress.
        sampling_time: in s.
        begin: parameters that the fits begin with; None: the starts.
        x0: initial states that the fits begin with; None: those of `samples`.
        stability: cost with which a fit is repeated whose linear part became unstable; None: none.
    """
    trees = [start if samples.known else {**start, "x0": samples.x0} for start in starts]
    runs = _Runs(structure, trees, samples, ridge, method, log, stability)
    first = [{**tree, **params} for tree, params in zip(trees, begin or trees, strict=True)]
    if x0 is not None:
        first = [{**tree, "x0": states} for tree, states in zip(first, x0, strict=True)]
    results = runs.fitted(first, None)
    choice, noise = NoiseChoice.of(method), None
    runs = runs._replace(method=replace(method, iterations=-(-method.iterations // 3)))
    for _ in range(0 if choice is None else NOISE_ROUNDS):
        assert choice is not None
        best = min(results, key=lambda r: r.cost)
        y = structure.simulate(best.params, best.x0, samples.u)[1]
        residual, floor = y - samples.y, np.full(structure.ny, LEAST_DEVIATION)
        before = noise
        noise = estimate_noise(residual, samples.weight, sampling_time, choice, floor)
        if settled(before, noise):
            break
        weighting = ErrorWeighting.of(noise, sampling_time, samples.weight, choice.huber)
        found = [r.params if samples.known else {**r.params, "x0": r.x0} for r in results]
        results = runs.fitted(found, weighting)
    return sorted(results, key=lambda r: r.cost)


class _Runs(NamedTuple):
    """Fits from several starts, with their common settings."""

    structure: StateSpaceStructure
    origins: Sequence[dict[str, Any]]
    samples: StateSamples
    ridge: dict[str, float]
    method: LevenbergMarquardt
    log: Progress
    stability: StabilityTerm | None

    def fitted(
        self, starts: Sequence[dict[str, Any]], weighting: ErrorWeighting | None
    ) -> list[StateFit]:
        """Continue the fits, in the order of the starts."""
        lowest, results = np.inf, list[StateFit]()
        for i, (origin, start) in enumerate(zip(self.origins, starts, strict=True)):
            pull = {
                name: jax.tree.map(lambda v, r=self.ridge[name]: np.full(np.shape(v), r), value)
                for name, value in origin.items()
            }
            rest, packing = packed(origin, np.float64), Packing.of(origin)
            data = chunked(self.samples, self.structure, packed(pull, np.float64), rest, weighting)
            watch: Watch = partial(self._watch, i, lowest)
            found, best, done = self._minimum(start, packing, data, watch)
            if self.stability is not None and not is_stable(self.structure, best):
                held = data._replace(stability=self.stability)
                begin = start if is_stable(self.structure, start) else origin
                again = self._minimum(begin, packing, held, watch)
                if np.isfinite(again[0].cost[0]):
                    found, best, done = again
            cost = float(found.cost[0])
            watch(done, cost)
            lowest = min(lowest, cost)
            x0 = best.pop("x0", self.samples.x0)
            results.append(StateFit(x0, best, cost, np.sqrt(found.history[0, : done + 1])))
        return results

    def _watch(self, i: int, lowest: float, done: int, cost: float) -> None:
        if np.isfinite(cost):
            count = i * self.method.iterations + done
            self.log(float(count), float(np.sqrt(min(lowest, cost))))

    def _minimum(
        self, start: dict[str, Any], packing: Packing, data: SampleChunks, watch: Watch
    ) -> tuple[Minimum, dict[str, Any], int]:
        equations = CompiledEquations(self.structure, packing, data, watch)
        theta = packed(start, np.float64)
        found = minimise(equations.costs, equations.normal, theta[None], self.method)
        return found, packing.unpack(found.theta[0]), equations.done


def is_stable(structure: StateSpaceStructure, params: dict[str, Any]) -> bool:
    """Whether the linear part is stable, integrators apart."""
    free = structure.order - structure.integrators
    return spectral_radius(params["a"][:free, :free]) < 1.0


def state_encoder(
    structure: StateSpaceStructure,
    fit: StateFit,
    records: ScaledData,
    context: Context,
) -> Encoder:
    """Map from the past window to the state, from the fitted model's own states on the records."""
    states = [
        structure.simulate(fit.params, fit.x0[i, None], r.u[None])[0][0]
        if len(r) > past_length(context)
        else np.zeros((0, structure.size))
        for i, r in enumerate(records)
    ]
    return window_encoder(
        records, lambda i: iter([states[i]]), context, ENCODER_UNITS, context.seed
    )
