"""Process models of records: gain, one to three lags, a zero, a delay, an integrator an input.

y(t) = offset + sum_j K_j (1 + Z_j s) e^(-L_j s) / (s^i (1 + T_1j s) ...) u_j(t), inputs held
between samples. Gains, zeros and offsets follow by least squares for given lags and delays, which
are found by Gauss-Newton steps from a grid of starts (variable projection: Golub and Pereyra, SIAM
J. Numer. Anal. 10(2), 1973). Source of the structures: Seborg et al., Process Dynamics and Control,
chapter 7.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from asia.candidate import ParameterEstimate
from asia.data.trajectory import Array, Trajectory
from asia.errors import UserError
from asia.lowering.linear import ProcessModel, discretize
from asia.models import uncertainty

# Samples that a fit takes from the records, from the first on.
_MOST_SAMPLES = 6_000
_STARTS = 2
# Decrease of the Bayesian information criterion that a larger structure must reach.
_EVIDENCE = 10.0


@dataclass(frozen=True)
class ProcessStructure:
    """Form of the transfer functions, the same for all inputs."""

    lags: int
    zero: bool = False
    integrator: bool = False


STRUCTURES = tuple(
    ProcessStructure(lags, zero, integrator)
    for integrator in (False, True)
    for lags, zero in ((1, False), (2, False), (2, True), (3, False), (3, True))
)
"""All structures that are compared where none is given."""


@dataclass(frozen=True)
class ProcessFit:
    """Process models from all inputs to one output, fitted to records."""

    structure: ProcessStructure
    models: tuple[ProcessModel, ...]
    """One an input; `fit` is that of the output to all inputs."""
    parameters: tuple[tuple[ParameterEstimate, ...], ...]
    """Gain, time constants, zero and delay of each input with their 95 % intervals."""
    offset: float
    """Output at zero inputs; with an integrator its rate."""
    at_rest: bool
    """Whether the records begin at rest."""


def fit_process(
    records: Sequence[Trajectory], output: int = 0, structure: ProcessStructure | None = None
) -> ProcessFit:
    """Fit process models to the simulation error of an output.

    Args:
        records: training records in physical units
        output: column of the output
        structure: form of the transfer functions; None takes the one with the least Bayesian
            information criterion

    Raises:
        UserError: for an output that does not change, and records that are too short
    """
    data = _Records(records, output)
    tried = list(STRUCTURES) if structure is None else [structure]
    best: tuple[_Fit, ProcessFit] | None = None
    for one in tried:
        # A third lag follows a second one, an integrator a lag that is as long as the records.
        if best is not None and (
            (one.lags == 3 and best[0].structure.lags == 1)
            or (one.integrator and not best[0].structure.integrator and not data.drifts(best[0]))
        ):
            continue
        found = data.fit(one, None if best is None else best[0])
        if found is None or (best is not None and found.evidence_over(best[0]) < _EVIDENCE):
            continue
        # A gain that may be zero belongs to a structure that the records do not determine.
        described = data.described(found)
        if best is None or all(p[0].low * p[0].high > 0 for p in described.parameters):
            best = found, described
    if best is None:
        raise UserError(
            f"process model: {data.samples} samples are too few for {data.nu} "
            f"input{'s' if data.nu > 1 else ''}"
        )
    return best[1]


@dataclass(frozen=True)
class _Fit:
    structure: ProcessStructure
    phi: Array
    """Logarithms of the lags and delays in samples (nu, lags + 1), flat."""
    error: Array
    """Residuals of all records, one after the other."""
    count: int
    """Number of parameters."""
    skipped: int | None
    """Samples at the start of each record that inputs before it may reach; None for records that
    begin at rest."""

    def evidence_over(self, other: _Fit) -> float:
        """Decrease of the Bayesian information criterion against another fit, where correlated
        residuals count as fewer independent ones."""
        squares, others = (float(one.error @ one.error) + 1e-300 for one in (self, other))
        correlation = float(self.error[1:] @ self.error[:-1]) / squares
        share = (1.0 - max(correlation, 0.0)) / (1.0 + max(correlation, 0.0))
        independent = max(len(self.error) * share, 2.0)
        return independent * math.log(others / squares) - (self.count - other.count) * math.log(
            independent
        )


class _Records:
    """Records of one output, and the regressions on them."""

    def __init__(self, records: Sequence[Trajectory], output: int) -> None:
        kept: list[Trajectory] = []
        for record in records:
            left = _MOST_SAMPLES - sum(map(len, kept))
            if left > 8:
                kept.append(record[: min(len(record), left)])
        self.step, self.nu = records[0].sampling_time, records[0].u.shape[1]
        self.u = [record.u for record in kept]
        self.seen = [record.measured[:, output] for record in kept]
        self.y = [record.y[:, output] for record in kept]
        self.samples = int(sum(seen.sum() for seen in self.seen))
        self.lengths = [len(u) for u in self.u]
        self.target = np.concatenate([y[s] for y, s in zip(self.y, self.seen, strict=True)])
        if not self.samples or float(self.target.std()) <= 0:
            raise UserError("process model: the output does not change")

    def columns(self, structure: ProcessStructure, phi: Array, record: int) -> tuple[Array, Array]:
        """Outputs of a record for unit parameters: those of the inputs (T, nu or 2 nu) and of
        offset or rate, and (T, q) those of its initial state."""
        u, time = self.u[record], np.arange(self.lengths[record])
        forced: list[Array] = []
        free = [np.ones(len(u))] if structure.integrator else []
        for j, row in enumerate(phi.reshape(self.nu, -1)):
            lags, delay = np.exp(row[:-1]), float(row[-1])
            chain = _Chain(lags, structure)
            first = u[0, j]
            for k, moved in enumerate(chain.outputs(u[:, j] - first, delay)):
                steady = first * (time if structure.integrator else 1.0)
                forced.append(moved + (steady if k == 0 else first * structure.integrator))
            free += chain.decays(len(u))
        rest = time.astype(float) if structure.integrator else np.ones(len(u))
        return np.stack([*forced, rest], axis=1), np.stack(free, axis=1)

    def design(
        self, structure: ProcessStructure, phi: Array, skipped: int | None
    ) -> tuple[Array, int]:
        """Regressors of all measured samples, 0 where a sample is skipped, and the number of those
        that all records share."""
        parts = [self.columns(structure, phi, r) for r in range(len(self.u))]
        widths = [
            (int(structure.integrator) if skipped is None else free.shape[1]) for _, free in parts
        ]
        rows: list[Array] = []
        for r, (forced, free) in enumerate(parts):
            own = np.zeros((len(forced), sum(widths)))
            start = sum(widths[:r])
            own[:, start : start + widths[r]] = free[:, : widths[r]]
            both = np.hstack([forced, own])
            both[: skipped or 0] = 0.0
            rows.append(both[self.seen[r]])
        return np.concatenate(rows), parts[0][0].shape[1]

    def solved(
        self, structure: ProcessStructure, phi: Array, skipped: int | None
    ) -> tuple[Array, Array, int]:
        """Best weights of the regressors for these lags and delays, measured minus simulated
        outputs, and the number of weights that all records share."""
        matrix, shared = self.design(structure, phi, skipped)
        scale = np.maximum(np.linalg.norm(matrix, axis=0), 1e-300)
        kept = np.concatenate(
            [np.arange(n)[s] for n, s in zip(self.lengths, self.seen, strict=True)]
        )
        target = np.where(kept < (skipped or 0), 0.0, self.target)
        weights = np.linalg.lstsq(matrix / scale, target, rcond=1e-11)[0] / scale
        return weights, target - matrix @ weights, shared

    def fit(self, structure: ProcessStructure, smaller: _Fit | None) -> _Fit | None:
        """Best fit of a structure; None where the samples do not suffice."""
        from scipy.optimize import least_squares

        lags, longest = structure.lags, max(self.lengths)
        count = self.nu * (lags + 2 + structure.zero) + 1
        if self.samples < 4 * count:
            return None
        low = np.tile([*[math.log(0.05)] * lags, 0.0], self.nu)
        high = np.tile([*[math.log(10.0 * longest)] * lags, longest / 3.0], self.nu)
        ratios = np.log(np.array([1.0, 0.4, 0.15])[:lags])
        grid = [
            np.tile([*(math.log(share) + ratios), delay], self.nu)
            for share in np.geomspace(1.0, max(longest / 3.0, 2.0), 9)
            for delay in (0.3, 1.5, 3.5, 7.5, 15.5)
            if delay < longest / 3.0
        ]
        known: list[Array] = []
        if smaller is not None:
            rows = smaller.phi.reshape(self.nu, -1)
            if rows.shape[1] - 1 < lags:
                extra = np.full((self.nu, lags + 1 - rows.shape[1]), math.log(0.5))
                rows = np.hstack([rows[:, :-1], extra, rows[:, -1:]])
            known = [rows.ravel()] if rows.shape[1] - 1 == lags else []
        best: _Fit | None = None
        for at_rest in (True, False):
            if not at_rest and min(self.lengths) <= 4 * (lags + 1) * self.nu:
                continue

            skipped = (
                None if at_rest or best is None else math.ceil(best.phi[lags :: lags + 1].max())
            )
            own = 0 if skipped is None else len(self.u) * (lags * self.nu + skipped)

            def residual(phi: Array, skipped: int | None = skipped) -> Array:
                return self.solved(structure, phi, skipped)[1]

            grid.sort(key=lambda phi: float(np.sum(residual(phi) ** 2)))
            for start in (*known, *grid[:_STARTS]):
                done: Any = least_squares(
                    residual, np.clip(start, low + 1e-6, high - 1e-6), bounds=(low, high),
                    x_scale="jac", max_nfev=60,
                )  # fmt: skip
                found = _Fit(structure, done.x, done.fun, count + own, skipped)
                if best is None or found.evidence_over(best) > 0.0:
                    best = found
        return best

    def drifts(self, found: _Fit) -> bool:
        """Whether a lag is longer than half the longest record."""
        lags = np.exp(found.phi.reshape(self.nu, -1)[:, :-1])
        return bool(lags.max() > 0.5 * max(self.lengths))

    def described(self, found: _Fit) -> ProcessFit:
        """Parameters in physical units with their intervals."""
        structure, size, step = found.structure, len(found.phi), self.step
        weights, _, shared = self.solved(structure, found.phi, found.skipped)
        theta = np.concatenate([found.phi, weights[:shared]])
        each, own = 1 + structure.zero, (len(weights) - shared) // len(self.u)

        def residuals(theta: Array) -> list[Array]:
            errors: list[Array] = []
            for r, y in enumerate(self.y):
                forced, free = self.columns(structure, theta[:size], r)
                one = weights[shared + r * own : shared + (r + 1) * own]
                errors.append((forced @ theta[size:] + free[:, :own] @ one - y)[:, None])
            return errors

        errors, slopes = uncertainty.jacobians_of(residuals, theta)
        nuisance = [
            self.columns(structure, found.phi, r)[1][:, None, :own] for r in range(len(self.u))
        ]
        used = [seen & (np.arange(len(seen)) >= (found.skipped or 0)) for seen in self.seen]
        masks = None if all(one.all() for one in used) else [one.astype(float) for one in used]
        unit = step if structure.integrator else 1.0

        def report(theta: Array) -> list[ParameterEstimate]:
            rest = float("nan"), float("nan"), float("nan")
            made: list[ParameterEstimate] = []
            for j, row in enumerate(theta[:size].reshape(self.nu, -1)):
                gain = theta[size + j * each] / unit
                made.append(ParameterEstimate("gain", float(gain), *rest))
                lags = np.sort(np.exp(row[:-1]))[::-1] * step
                made += [
                    ParameterEstimate(f"time constant {k}", float(t), *rest, "s", lower=1e-300)
                    for k, t in enumerate(lags, 1)
                ]
                if structure.zero:
                    zero = theta[size + j * each + 1] / theta[size + j * each] * step
                    made.append(ParameterEstimate("zero", float(zero), *rest, "s"))
                made.append(ParameterEstimate("delay", float(row[-1] * step), *rest, "s"))
            return made

        covariance = uncertainty.sandwich(errors, slopes, nuisance=nuisance, measured=masks)
        flat = uncertainty.estimates(covariance, report, theta).parameters
        flat = tuple(
            replace(
                p,
                low=max(min(p.low, p.value - p.misfit_error), 0.0 if p.unit == "s" else -math.inf)
                if p.name != "zero" else min(p.low, p.value - p.misfit_error),
                high=max(p.high, p.value + p.misfit_error),
            )
            for p in flat
        )  # fmt: skip
        per = len(flat) // self.nu
        groups = tuple(flat[j * per : (j + 1) * per] for j in range(self.nu))
        spread = float(np.linalg.norm(self.target - self.target.mean()))
        fit = 100.0 * (1.0 - float(np.linalg.norm(found.error)) / spread)
        models = tuple(_model(group, structure, fit) for group in groups)
        return ProcessFit(structure, models, groups, float(theta[-1]) / unit, found.skipped is None)


def _model(
    group: Sequence[ParameterEstimate], structure: ProcessStructure, fit: float
) -> ProcessModel:
    values = [one.value for one in group]
    lags = tuple(values[1 : 1 + structure.lags])
    zero = values[-2] if structure.zero else 0.0
    return ProcessModel(values[0], lags, zero, values[-1], structure.integrator, fit)


class _Chain:
    """First-order lags in a row, and an integrator at the end: outputs for held inputs. Time is in
    samples."""

    def __init__(self, lags: Array, structure: ProcessStructure) -> None:
        n = len(lags)
        size = n + structure.integrator
        a, b = np.zeros((size, size)), np.zeros((size, 1))
        for i, lag in enumerate(lags):
            a[i, i] = -1.0 / lag
            if i == 0:
                b[0] = 1.0 / lag
            else:
                a[i, i - 1] = 1.0 / lag
        if structure.integrator:
            a[n, n - 1] = 1.0
        c = np.zeros((1 + structure.zero, size))
        c[0, -1] = 1.0
        if structure.zero:
            # Derivative of the output, which the input does not reach directly.
            c[1] = a[-1]
        self.a, self.b, self.c, self.lags = a, b, c, lags
        self.integrator = structure.integrator

    def outputs(self, u: Array, delay: float) -> list[Array]:
        """Outputs (T,), one a row of C, from rest."""
        whole = int(delay)
        late = delay - whole
        power, _ = discretize(self.a, self.b, 1.0)
        after, now = discretize(self.a, self.b, 1.0 - late)
        before = after @ discretize(self.a, self.b, late)[1]
        state, impulse = np.zeros(len(self.a)), np.zeros((len(self.a) + 2, len(self.c)))
        for k in range(len(impulse)):
            impulse[k] = self.c @ state
            state = power @ state + (now[:, 0] if k == 0 else before[:, 0] if k == 1 else 0.0)
        late_u = np.concatenate([np.zeros(whole), u])[: len(u)]
        return [self._filtered(response, late_u) for response in impulse.T]

    def decays(self, samples: int) -> list[Array]:
        """Free responses (T,) of the lags at the output; that of an integrator is a constant."""
        power, _ = discretize(self.a, self.b, 1.0)
        state = np.eye(len(self.a))[:, : len(self.lags)]
        first = np.empty((len(self.a) + 1, len(self.lags)))
        for k in range(len(first)):
            first[k] = state[-1]
            state = power @ state
        pulse = np.zeros(samples)
        pulse[0] = 1.0
        return [self._filtered(response, pulse) for response in first.T]

    def _filtered(self, response: Array, u: Array) -> Array:
        """Outputs (T,) of a filter with these poles, known by its first impulse response."""
        from scipy.signal import lfilter

        poles = [math.exp(-1.0 / lag) for lag in self.lags] + [1.0] * self.integrator
        denominator = np.poly(poles)
        numerator = np.convolve(denominator, response)[: len(response)]
        return np.asarray(lfilter(numerator, denominator, u), np.float64)
