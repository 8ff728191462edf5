"""Standard errors of parameters fitted to simulation errors, for any candidate.

    covariance = uncertainty.sandwich(residuals, jacobians)

With H = J'J + R and residuals e, the covariance of the estimate is H^-1 (J' cov(e) J) H^-1. The
residuals of a simulation are correlated in time, so that cov(e) is not a multiple of the unit
matrix: it is that of an autoregressive process fitted to them, for each output, with correlated
innovations. Where the residuals follow the sensitivities in a way that noise does not explain, an
effect is missing: `misfit` is the size of what it left. The rows of J are 0 where a sample was not
measured, and the process is estimated from the stretches between such samples. Sources: White,
Econometrica 50(1), 1982; Ljung, System Identification, 2nd ed., 1999, chapter 9; Burg's method:
Kay, Modern Spectral Estimation, 1988, section 7.5.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from asia.candidate import ParameterEstimate, ParameterEstimates
from asia.data.trajectory import Array
from asia.models._noise.model import ResidualProcess, lfilter

__all__ = ["Covariance", "PriorPenalty", "estimates", "gradient", "jacobians_of", "sandwich"]

# Assumed ratio of the effect absorbed by the parameters to the one left in the residuals. On 36
# systems with a missing effect 2 held 89 % of the true values, and 2.5 held 94 %.
_ABSORBED = 2.5
_MISFIT_LAGS = (1, 2, 4, 8)
# Shortest stretch of measured samples that tells how residuals are correlated in time.
_SHORTEST = 20
# Greatest number of rows of the test for a missing effect, and of combinations of sensitivities.
_MISFIT_ROWS, _MISFIT_DIRECTIONS = 20_000, 6


@dataclass(frozen=True)
class Covariance:
    """Covariance of the estimates of P coordinates."""

    matrix: Array
    """(P, P)."""
    from_prior: Array
    """(P, P): H^-1 R H^-1, the part of H^-1 that comes only from the ridge."""
    information: Array
    """(P, P): H^-1; large in directions of which the records and the ridge carry little
    information."""
    unknown: Array
    """(P, k): directions of which neither records nor ridge carry information."""
    freedom: float
    """Degrees of freedom of the residuals, correlation taken into account."""
    misfit: float = 0.0
    """Root of the sum of squares that a missing effect left in the residuals; 0 where they show
    none."""


@dataclass(frozen=True)
class PriorPenalty:
    """Prior knowledge: weight times a sum of squared deviations from known values, each over its
    standard deviation."""

    matrix: Array
    """(P, P): contribution of the penalty to the normal equations, the weight included."""
    weight: float
    """Weight of the sum. With white residuals of variance s the sum of squares is a likelihood
    where this is s. Another weight makes the estimate another one, but the knowledge no better."""


def sandwich(
    residuals: Sequence[Array],
    jacobians: Sequence[Array],
    ridge: Array | None = None,
    nuisance: Sequence[Array] | None = None,
    prior: PriorPenalty | None = None,
    measured: Sequence[Array] | None = None,
) -> Covariance:
    """Covariance of coordinates that minimise the sum of squares.

    Args:
        residuals: (T, ny) of each record.
        jacobians: their derivatives (T, ny, P).
        ridge: R (P, P) where the sum has theta' R theta in addition to the squares.
        nuisance: derivatives (T, ny, Q) by the unknowns of each record, such as its initial state.
        prior: prior knowledge in the same sum.
        measured: masks (T, ny) of each record, positive where an output is in the sum; None: all.

    Raises:
        ValueError: if the measured stretches are too short to show how residuals are correlated.
    """
    if nuisance is None:
        nuisance = [np.zeros((*e.shape, 0)) for e in residuals]
    if measured is None:
        measured = [np.ones(e.shape) for e in residuals]
    stretches = _stretches(measured)
    slopes = jacobians
    residuals, jacobians, nuisance = (
        _counted(parts, measured) for parts in (residuals, jacobians, nuisance)
    )
    free = [_projected(j, q) for j, q in zip(jacobians, nuisance, strict=True)]
    count = free[0].shape[-1]
    held = np.zeros((count, count)) if ridge is None else ridge
    known = PriorPenalty(np.zeros((count, count)), 0.0) if prior is None else prior
    weights = held + known.matrix
    own = sum((np.einsum("typ,tyq->pq", j, j) for j in free), np.zeros((count, count)))
    inverse, unknown = _inverse(own + weights)
    noise = ResidualProcess.of(residuals, jacobians, nuisance, stretches)
    if len(residuals) >= max(30, 5 * count):
        # Each record counts as one cluster.
        sums = np.stack(
            [np.einsum("typ,ty->p", j, e) for j, e in zip(free, residuals, strict=True)]
        )
        middle = sums.T @ sums
    else:
        middle = sum((noise.middle(j) for j in free), np.zeros((count, count)))
    squares = sum(float((e**2).sum()) for e in residuals)
    lost = float(np.trace(inverse @ middle))
    for one in nuisance:
        # Part of the squares that a record's own unknowns absorb.
        basis = _basis(one)
        if basis.size:
            shaped = basis.reshape(*one.shape[:2], -1)
            lost += float(np.trace(noise.middle(shaped)))
    # Noise absorbed by the fit, if the process does not account for it.
    kept = max(1.0 - lost / squares, 0.05) if squares > 0 else 1.0
    samples = sum(int((mask > 0).sum()) for mask in measured)
    variance = squares / kept / samples
    rest = 1.0 if noise.restricted else kept
    spread = middle / rest + variance * held + known.weight * known.matrix
    matrix = inverse @ spread @ inverse
    freedom = max(noise.independent(samples) * kept, 1.0)
    return Covariance(
        matrix, inverse @ weights @ inverse, inverse, unknown, freedom,
        _misfit(residuals, slopes, nuisance, noise, stretches, samples),
    )  # fmt: skip


def gradient(
    residuals: Sequence[Array],
    jacobians: Sequence[Array],
    nuisance: Sequence[Array],
    measured: Sequence[Array],
) -> Array:
    """Half the gradient (P,) of the sum of squares, with the unknowns of each record fitted anew.

    Arguments are those of `sandwich`. It is 0 at a minimum.
    """
    jacobians, nuisance = _counted(jacobians, measured), _counted(nuisance, measured)
    free = (_projected(j, q) for j, q in zip(jacobians, nuisance, strict=True))
    parts = [np.einsum("typ,ty->p", j, e) for j, e in zip(free, residuals, strict=True)]
    return np.sum(parts, axis=0)


def estimates(
    covariance: Covariance,
    report: Callable[[Array], Sequence[ParameterEstimate]],
    theta: Array,
    equations: Sequence[str] = (),
) -> ParameterEstimates:
    """Standard errors, intervals and correlations of the parameters that `report` makes of
    coordinates.

    A parameter with a range of positive numbers has an interval on the logarithmic scale.

    Args:
        covariance: covariance of the coordinates.
        report: makes the parameters from coordinates.
        theta: coordinates (P,).
        equations: lines of the equations.
    """
    plain = list(report(theta))

    def values(x: Array) -> list[Array]:
        return [np.array([p.value for p in report(x)])]

    slopes = jacobians_of(values, theta, 1e-5)[1][0]
    matrix = slopes @ covariance.matrix @ slopes.T
    errors = np.sqrt(np.maximum(np.diagonal(matrix), 0.0))
    size = np.linalg.norm(slopes, axis=1)
    lost = np.linalg.norm(slopes @ covariance.unknown, axis=1) > 1e-3 * np.maximum(size, 1e-300)
    errors = np.where(lost, np.inf, errors)
    priors, alls = (
        np.einsum("ip,pq,iq->i", slopes, part, slopes)
        for part in (covariance.from_prior, covariance.information)
    )
    shares = np.clip(1.0 - priors / np.where(alls > 0, alls, 1.0), 0.0, 1.0)
    shares = np.where(lost, 0.0, shares)
    from scipy.special import stdtrit

    factor = float(stdtrit(covariance.freedom, 0.975))
    misfits = _ABSORBED * covariance.misfit * np.sqrt(np.maximum(alls, 0.0))
    found: list[ParameterEstimate] = []
    for one, error, share, misfit in zip(plain, errors, shares, misfits, strict=True):
        wide = factor * float(error)
        low, high = one.value - wide, one.value + wide
        if one.lower > 0 and one.value > 0:
            with np.errstate(over="ignore"):
                ratio = float(np.exp(wide / one.value))
            low, high = one.value / ratio, one.value * ratio
        found.append(
            replace(
                one,
                standard_error=float(error),
                low=low,
                high=high,
                data_share=float(share),
                misfit_error=float(misfit),
            )
        )
    with np.errstate(all="ignore"):
        correlation = matrix / (errors[:, None] * errors)
    correlation[lost], correlation[:, lost] = np.nan, np.nan
    return ParameterEstimates(tuple(found), np.clip(correlation, -1.0, 1.0), tuple(equations))


def jacobians_of(
    residuals: Callable[[Array], Sequence[Array]], theta: Array, step: float = 1e-6
) -> tuple[list[Array], list[Array]]:
    """Residuals (T, ny) of each record at theta (P,), and their derivatives (T, ny, P) by central
    differences with this relative step."""
    steps = step * np.maximum(np.abs(theta), 1.0)
    at = [np.asarray(e) for e in residuals(theta)]
    slopes = [np.empty((*e.shape, len(theta))) for e in at]
    for k, h in enumerate(steps.tolist()):
        unit = np.zeros(len(theta))
        unit[k] = h
        up, down = residuals(theta + unit), residuals(theta - unit)
        for found, more, less in zip(slopes, up, down, strict=True):
            found[..., k] = (more - less) / (2 * h)
    return at, slopes


def _counted(parts: Sequence[Array], measured: Sequence[Array]) -> Sequence[Array]:
    """Arrays (T, ny, ...) of the records, 0 where an output was not measured."""
    return [
        part
        if (mask > 0).all()
        else np.where((mask > 0).reshape(*mask.shape, *[1] * (part.ndim - 2)), part, 0.0)
        for part, mask in zip(parts, measured, strict=True)
    ]


def _stretches(measured: Sequence[Array]) -> list[list[list[slice]]]:
    """Stretches of each output of each record in which it was measured, without short ones."""
    found: list[list[list[slice]]] = [[] for _ in measured]
    for i in range(measured[0].shape[1]):
        for own, mask in zip(found, measured, strict=True):
            edges = np.flatnonzero(np.diff(np.pad((mask[:, i] > 0).astype(int), 1))).reshape(-1, 2)
            whole = len(edges) == 1  # a short record without a gap counts
            own.append([slice(a, b) for a, b in edges.tolist() if whole or b - a >= _SHORTEST])
        used = sum(part.stop - part.start for own in found for part in own[i])
        if 2 * used < sum(int((mask[:, i] > 0).sum()) for mask in measured):
            raise ValueError(
                f"output {i + 1} was measured mostly in stretches of less than {_SHORTEST} "
                "samples, too short to show how its errors are correlated in time"
            )
    return found


def _projected(jacobian: Array, nuisance: Array) -> Array:
    """Remove from the jacobian the part that the record's own unknowns explain (Frisch and
    Waugh)."""
    flat, own = jacobian.reshape(-1, jacobian.shape[-1]), _basis(nuisance)
    explained = own @ (own.T @ flat)
    return np.subtract(flat, explained, out=explained).reshape(jacobian.shape)


def _basis(columns: Array) -> Array:
    """Orthonormal columns (T ny, k) that span those of (T, ny, Q)."""
    flat = columns.reshape(columns.shape[0] * columns.shape[1], columns.shape[2])
    left, sizes, _ = np.linalg.svd(flat, full_matrices=False)
    return left[:, sizes > 1e-9 * max(float(sizes.max(initial=0.0)), 1e-300)]


def _inverse(gram: Array) -> tuple[Array, Array]:
    """Inverse where there is one, 0 in the directions (P, k) where there is none."""
    scale = np.sqrt(np.diagonal(gram))
    scale = np.where(scale > 0, scale, 1.0)
    sizes, ways = np.linalg.eigh(gram / (scale[:, None] * scale))
    # With ones on the diagonal, smaller eigenvalues are rounding.
    known = sizes > 1e-14 * max(len(gram), 1)
    inside = ways[:, known] / scale[:, None]
    unknown = ways[:, ~known] / scale[:, None]
    norms = np.linalg.norm(unknown, axis=0)
    return (inside / sizes[known]) @ inside.T, unknown / np.where(norms > 0, norms, 1.0)


def _misfit(
    residuals: Sequence[Array],
    jacobians: Sequence[Array],
    nuisance: Sequence[Array],
    noise: ResidualProcess,
    stretches: Sequence[Sequence[Sequence[slice]]],
    samples: int,
) -> float:
    """Root of the sum of squares that lags, products, cubes and bends of the sensitivities
    explain of the residuals; 0 where an F test after whitening finds that noise explains it."""
    used = 0
    kept: list[tuple[Array, Array, Array]] = []
    spans: list[list[list[slice]]] = []
    most = _MISFIT_ROWS // residuals[0].shape[1] + 1
    lost = max(len(a) for a in noise.filters) - 1
    shortest = 2 * lost + max(_MISFIT_LAGS)
    for e, jacobian, one, those in zip(residuals, jacobians, nuisance, stretches, strict=True):
        cut = [[slice(s.start, min(s.stop, most)) for s in own] for own in those]
        long = [[s for s in own if s.stop - s.start > shortest] for own in cut]
        if used < _MISFIT_ROWS and any(long):
            kept.append((e[:most], jacobian[:most], one[:most]))
            spans.append(long)
            used += e.size
    if not kept or not jacobians[0].shape[-1]:
        return 0.0
    from scipy.special import fdtrc

    e, slopes, own = ([record[i] for record in kept] for i in range(3))
    groups = _shapes(slopes)
    white, tests = _explained(e, slopes, own, groups, noise.filters, spans)
    chances: list[float] = []
    for basis in tests:
        freedom = white.size - basis.shape[1] - slopes[0].shape[-1]
        part = float(((basis.T @ white) ** 2).sum())
        if freedom > 0 and 0 < basis.shape[1] < freedom / 4:
            rest = max(float(white @ white) - part, 1e-300)
            ratio = part / basis.shape[1] / (rest / freedom)
            chances.append(float(fdtrc(basis.shape[1], freedom, ratio)))
    # The smallest of the probabilities, corrected for their number.
    if not chances or len(chances) * min(chances) > 0.1:
        return 0.0
    unfiltered = [np.ones(1)] * len(noise.filters)
    plain, parts = _explained(e, slopes, own, groups, unfiltered, spans)
    left, sizes, _ = np.linalg.svd(np.concatenate(parts, axis=1), full_matrices=False)
    explained = left[:, sizes > 0.1].T @ plain
    return float(np.sqrt(explained @ explained * samples / plain.size))


def _shapes(jacobians: Sequence[Array]) -> list[list[Array]]:
    """Lags, products, cubes and bends (T, ny, columns) of the sensitivities of each record."""
    flat = np.concatenate([j.reshape(-1, j.shape[-1]) for j in jacobians])
    size = np.std(flat, axis=0)
    transform = np.diag(1.0 / np.where(size > 0, size, 1.0))
    if len(size) > _MISFIT_DIRECTIONS:
        scaled = flat @ transform
        _, ways = np.linalg.eigh(scaled.T @ scaled)
        transform = transform @ ways[:, -_MISFIT_DIRECTIONS:]
        size = np.std(flat @ transform, axis=0)
        transform = transform / np.where(size > 0, size, 1.0)
    found: list[list[Array]] = []
    for j in jacobians:
        z = j @ transform
        first, second = np.triu_indices(z.shape[-1])
        lags = [np.concatenate([np.zeros_like(z[:n]), z[:-n]]) for n in _MISFIT_LAGS]
        cubes = (z[..., :, None] * z[..., None, :] ** 2).reshape(*z.shape[:2], -1)
        bends = np.concatenate([np.tanh(5.0 * z), z * np.abs(z)], axis=-1)
        found.append([np.concatenate(lags, axis=-1), z[..., first] * z[..., second], cubes, bends])
    return [list(group) for group in zip(*found, strict=True)]


def _explained(
    residuals: Sequence[Array],
    jacobians: Sequence[Array],
    nuisance: Sequence[Array],
    groups: Sequence[Sequence[Array]],
    filters: Sequence[Array],
    stretches: Sequence[Sequence[Sequence[slice]]],
) -> tuple[Array, list[Array]]:
    """Filtered residuals (N,) and an orthonormal basis (N, m) of each group in the stretches of
    each record, both without what the parameters and the records' own unknowns explain."""
    lost = max(len(a) for a in filters) - 1

    def white(part: Array, those: Sequence[Sequence[slice]]) -> Array:
        parts = [
            lfilter(a, [1.0], part[s, i], axis=0)[lost:]
            for i, a in enumerate(filters)
            for s in those[i]
        ]
        return np.concatenate(parts)[:, None]

    def joined(parts: Sequence[Array]) -> Array:
        kept = [white(*one) for one in zip(parts, stretches, strict=True)]
        if nuisance[0].size:
            own = [white(*one) for one in zip(nuisance, stretches, strict=True)]
            kept = [_projected(*both) for both in zip(kept, own, strict=True)]
        return np.concatenate([one.reshape(-1, one.shape[-1]) for one in kept])

    held = _basis(joined(jacobians)[:, None, :])
    e = joined([one[..., None] for one in residuals])[:, 0]
    bases: list[Array] = []
    for group in groups:
        columns = joined(group)
        size = np.linalg.norm(columns, axis=0)
        columns = columns / np.where(size > 0, size, 1.0)
        left, sizes, _ = np.linalg.svd(columns - held @ (held.T @ columns), full_matrices=False)
        bases.append(left[:, sizes > 0.02])
    return e - held @ (held.T @ e), bases
