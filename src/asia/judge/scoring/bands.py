"""Output bands and the region of validity."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from asia.data.trajectory import Array, filled

# Bands around a simulation, from the errors of fold models where these were not fitted.
#
# Source: CV+ of Barber, Candes, Ramdas, Tibshirani, Predictive inference with the jackknife+,
# Annals of Statistics 49 (2021). Their guarantee wants independent samples. Here the samples of a
# block depend on each other, so the level is raised for as few independent errors as there are.


_HALVINGS = 50
# Of so many values at most, the edge is one of them in order; of more it is found by halving.
_FEW = 1 << 16
# Steps of a window whose errors count as errors of one step, as a share of the window.
_NEIGHBOURS = 0.02


@dataclass(frozen=True)
class HeldOutErrors:
    """Errors of the model of one fold on the blocks that the fold holds out."""

    blocks: tuple[Array, ...]
    """Measured less simulated (H, ny), one a block; NaN where an output was not measured."""


@dataclass(frozen=True)
class Bands:
    """Bands around one simulation that contain the measured outputs with a given probability."""

    lower: Array
    """(H, ny), in the units of the outputs."""
    upper: Array
    """(H, ny)."""


@dataclass(frozen=True)
class ErrorSizes:
    """Sorted sizes of held-out errors, from which bands of every level are made."""

    parts: tuple[tuple[tuple[Array, ...], ...], ...]
    """For each output and each step of a window (one where errors do not depend on the step): the
    sizes of each fold's errors, the smallest first."""
    independent: tuple[float, ...]


def error_sizes(folds: Sequence[HeldOutErrors], *, by_step: bool = False) -> ErrorSizes:
    """The sizes of the errors of fold models.

    Args:
        by_step: the blocks are windows of one length, and errors depend on the step in it
    """
    parts: list[tuple[tuple[Array, ...], ...]] = []
    independent: list[float] = []
    for channel in range(folds[0].blocks[0].shape[1]):
        errors = [[block[:, channel] for block in fold.blocks] for fold in folds]
        if by_step:
            # The errors at a step count with those of a few steps around it.
            length = min(len(block) for blocks in errors for block in blocks)
            near = int(_NEIGHBOURS * length)
            stacked = [np.stack([block[:length] for block in blocks]) for blocks in errors]
            around = [slice(max(0, step - near), step + near + 1) for step in range(length)]
            parts.append(tuple(tuple(_sizes(s[:, part], s) for s in stacked) for part in around))
        else:
            whole = [np.concatenate(blocks) for blocks in errors]
            parts.append((tuple(_sizes(one, np.zeros(1)) for one in whole),))
        complete = [[filled(block[:, None])[:, 0] for block in blocks] for blocks in errors]
        independent.append(independent_errors(complete))
    return ErrorSizes(tuple(parts), tuple(independent))


def output_bands(
    errors: Sequence[HeldOutErrors] | ErrorSizes,
    y_hat: Array,
    level: float,
    wider: Array | None = None,
    *,
    by_step: bool = False,
) -> Bands:
    """Bands for the simulations (K, H, ny) of K fold models, which a measured output leaves with a
    probability of 1 - level.

    Args:
        errors: one a fold model, or their sizes, where many simulations have the same
        wider: (H,) factors of 1 or more on the errors, None for 1
        by_step: as in `error_sizes`

    Raises:
        ValueError: for a level outside (0, 1)
    """
    if not 0.0 < level < 1.0:
        raise ValueError(f"level is {level}, expected a share between 0 and 1")
    sizes = errors if isinstance(errors, ErrorSizes) else error_sizes(errors, by_step=by_step)
    _, samples, outputs = y_hat.shape
    factor = np.ones(samples) if wider is None else wider
    lower, upper = np.zeros((samples, outputs)), np.zeros((samples, outputs))
    for channel in range(outputs):
        reach = raised_level(level, sizes.independent[channel])
        steps = sizes.parts[channel]
        for step, own in enumerate(steps[:samples]):
            part = slice(step, samples if step == len(steps) - 1 else step + 1)
            centres = y_hat[:, part, channel]
            upper[part, channel] = _edge(own, centres, factor[part], reach)
            lower[part, channel] = -_edge(own, -centres, factor[part], reach)
    return Bands(lower, upper)


KNOWN_WITHIN = 0.05
"""Largest standard error of the share that bands hold of a fold which did not make them. Above it
nobody knows what a band holds."""


@dataclass(frozen=True)
class Calibration:
    """Check of bands on folds that did not make them."""

    level: float
    factor: Array
    """(ny,), 1 or more: bands made without a fold hold `level` of it when they are so much wider,
    over all folds."""
    held: Array
    """(K, ny): the share that the widened bands made without a fold hold of it."""
    error: Array
    """(ny,): standard error of the mean over the folds of that share: by their scatter, or by the
    number of independent errors."""

    @property
    def withdrawn(self) -> tuple[str, ...]:
        """The reason why there is no band, one an output; "" where there is one."""
        reasons: list[str] = []
        for held, error in zip(self.held.T, self.error.tolist(), strict=True):
            few = "a single fold cannot check a band: use two or more"
            part = (
                f"bands made without a fold hold {100 * held.min():.0f} to "
                f"{100 * held.max():.0f} % of it in place of {100 * self.level:g} %: the errors "
                "are too few, or not alike in all parts of the records"
            )
            reasons.append(few if len(held) < 2 else part if error > KNOWN_WITHIN else "")
        return tuple(reasons)


def calibrate(
    folds: Sequence[HeldOutErrors], level: float, *, by_step: bool = False
) -> Calibration:
    """Check bands of the level on each fold with those of the other folds, and widen them until
    they hold the level over all folds (jackknife over folds, which keeps correlated errors
    together).

    Args:
        by_step: as in `error_sizes`
    """
    ny = folds[0].blocks[0].shape[1]
    if len(folds) < 2:
        return Calibration(level, np.ones(ny), np.full((1, ny), np.nan), np.full(ny, np.inf))
    ratios: list[Array] = []
    for k, fold in enumerate(folds):
        sizes = error_sizes([*folds[:k], *folds[k + 1 :]], by_step=by_step)
        edges = np.stack([
            [_quantile(np.concatenate(own), raised_level(level, sizes.independent[channel]))
             for own in steps]
            for channel, steps in enumerate(sizes.parts)
        ], axis=1)  # fmt: skip
        edges = np.maximum(edges, np.finfo(np.float64).tiny)
        parts = [
            np.abs(block) / edges[np.minimum(np.arange(len(block)), len(edges) - 1)]
            for block in fold.blocks
        ]
        ratios.append(np.concatenate(parts))
    factor = np.array([_quantile(r, level) for r in np.concatenate(ratios).T])
    factor = np.maximum(factor, 1.0)
    # An unmeasured output, NaN, is not inside and does not count.
    inside = [(np.abs(r) <= factor).sum(axis=0) for r in ratios]
    measured = [(~np.isnan(r)).sum(axis=0) for r in ratios]
    held = np.array(inside) / np.maximum(measured, 1)
    # Of all folds together: at most so many errors are independent.
    worth = np.array(error_sizes(folds, by_step=by_step).independent)
    scatter = held.std(axis=0, ddof=1) / np.sqrt(len(folds))
    error = np.maximum(scatter, np.sqrt(level * (1.0 - level) / np.maximum(worth, 1.0)))
    return Calibration(level, factor, held, error)


def _quantile(values: Array, level: float) -> float:
    """The value that a share `level` of the known ones does not exceed; 0 where none is known."""
    known = np.sort(values[~np.isnan(values)])
    return float(known[max(0, int(np.ceil(level * len(known) - 1e-9)) - 1)]) if len(known) else 0.0


def independent_errors(folds: Sequence[Sequence[Array]]) -> float:
    """Return the equivalent number of independent held-out errors.

    It is their number over the sum of their autocorrelation up to its first zero crossing, on both
    sides.

    Args:
        folds: blocks (H,) of each fold
    """
    worth = 0.0
    for blocks in folds:
        centre = np.concatenate(list(blocks)).mean()
        for block in blocks:
            worth += len(block) / _correlation_length(block - centre)
    return worth


def _correlation_length(error: Array) -> float:
    size = 2 * len(error)
    power = np.abs(np.fft.rfft(error, size)) ** 2
    covariance = np.fft.irfft(power, size)[: len(error)]
    if covariance[0] <= 0.0:
        return float(len(error))
    correlation = covariance / covariance[0]
    crossing = np.flatnonzero(correlation <= 0.0)
    until = int(crossing[0]) if len(crossing) else len(error)
    return min(float(len(error)), 1.0 + 2.0 * float(correlation[1:until].sum()))


def raised_level(level: float, errors: float) -> float:
    """The share of the known errors that a band of this level holds, for so many independent
    ones: (1 + 1 / errors) times the level, 1 at most."""
    return min(1.0, level * (1.0 + 1.0 / max(errors, 1.0)))


def _sizes(errors: Array, otherwise: Array) -> Array:
    """Sizes of the errors that are known, the smallest first; of `otherwise` where none is."""
    known = errors[~np.isnan(errors)]
    return np.sort(np.abs(known if len(known) else otherwise[~np.isnan(otherwise)]))


def _edge(sizes: Sequence[Array], centres: Array, factor: Array, level: float) -> Array:
    """The lowest values (H,) that a share `level` of all centre + factor * size stays below; sizes
    sorted, one a fold; centres (K, H)."""
    total = sum(len(s) for s in sizes)
    wanted = level * total - 1e-9 * total
    if total * centres.shape[1] <= _FEW:
        every = [c + factor * s[:, None] for s, c in zip(sizes, centres, strict=True)]
        rank = max(0, int(np.ceil(wanted)) - 1)
        return np.partition(np.concatenate(every), rank, axis=0)[rank]
    low = np.min(centres, axis=0)
    most = np.array([s[-1] if len(s) else 0.0 for s in sizes])
    high = np.max(centres + factor * most[:, None], axis=0)
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        below = np.zeros(len(middle))
        for size, centre in zip(sizes, centres, strict=True):
            below += np.searchsorted(size, (middle - centre) / factor, side="right")
        enough = below >= wanted
        high = np.where(enough, middle, high)
        low = np.where(enough, low, middle)
    return high


# The region of validity: where inputs and outputs are like those of the training records.


# Lengths of the moving averages, in samples, that describe the recent past of an input; of longer
# ones a short cloud has too few.
_LENGTHS = (1, 4, 16, 64)
_SHORTEST_CLOUD = 16
_SHARE = 0.99
_RIDGE = 1e-6
# How far beyond the training range a signal still counts as inside, in half ranges from the middle.
_REACH = 1.2
# How far beyond the training the changes of an input may go, as a share of the largest there.
_FASTER = 1.1


@dataclass(frozen=True)
class Region:
    """A cloud of training samples, described by moving averages of the inputs and the outputs; the
    range of each signal; and how fast the inputs change."""

    centre: Array
    whiten: Array
    """(features, features): (x - centre) @ whiten has unit covariance over the cloud."""
    edge: float
    """The distance that 99 % of the cloud lies within."""
    lengths: tuple[int, ...]
    """Lengths of the moving averages, in samples."""
    mean: Array
    """(nu,): mean of each input."""
    change: Array
    """Mean square (nu,) of the change of each input from sample to sample."""
    fastest: Array
    """(nu,): the root mean square, over the longest average, of the changes of each input that is
    inside; infinite for an input that never changes."""
    middle: Array
    """(nu + ny,): the middle of the range of each input and output."""
    reach: Array
    """(nu + ny,): how far from the middle a signal is inside."""

    def distance(self, past_u: Array, u: Array, y: Array) -> Array:
        """Distance (H,) of each sample over that of the edge: above 1 is outside. The largest of
        the Mahalanobis distance from the cloud, the distance of any signal from the middle of its
        range, and how fast any input changes. past_u (n, nu), u (H, nu), y (H, ny), measured or
        simulated."""
        features = _features(past_u, u, y, self.lengths, self.mean)
        far = np.linalg.norm((features - self.centre) @ self.whiten, axis=1) / self.edge
        signals = np.concatenate([u, y], axis=1)
        beyond = np.max(np.abs(signals - self.middle) / self.reach, axis=1)
        fast = np.max(_changes(past_u, u, max(self.lengths), self.change) / self.fastest, axis=1)
        return np.maximum(np.maximum(far, beyond), fast)


def region_of(records: Sequence[tuple[Array, Array]]) -> Region:
    """The region of training records (u (N, nu), y (N, ny))."""
    samples = sum(len(u) for u, _ in records)
    lengths = tuple(n for n in _LENGTHS if n == 1 or _SHORTEST_CLOUD * n <= samples)
    mean = np.concatenate([u for u, _ in records]).mean(axis=0)
    cloud = np.concatenate([_features(u[:0], u, y, lengths, mean) for u, y in records])
    centre = cloud.mean(axis=0)
    covariance = np.atleast_2d(np.cov(cloud, rowvar=False, bias=True))
    deviation = np.sqrt(np.diag(covariance))
    deviation[deviation == 0.0] = 1.0
    values, vectors = np.linalg.eigh(covariance / np.outer(deviation, deviation))
    whiten = (vectors / np.sqrt(np.maximum(values, _RIDGE))) / deviation[:, None]
    distances = np.linalg.norm((cloud - centre) @ whiten, axis=1)
    edge = max(float(np.quantile(distances, _SHARE)), np.finfo(np.float64).tiny)
    signals = np.concatenate([np.concatenate([u, y], axis=1) for u, y in records])
    low, high = signals.min(axis=0), signals.max(axis=0)
    middle, reach = 0.5 * (low + high), 0.5 * _REACH * (high - low)
    still = reach == 0.0
    reach[still] = 1e-3 * np.where(middle == 0.0, 1.0, np.abs(middle))[still]
    steps = [np.diff(u, axis=0) ** 2 for u, _ in records]
    change = np.concatenate(steps).sum(axis=0) / max(1, sum(map(len, steps)))
    moved = [_changes(u[:0], u, max(lengths), change) for u, _ in records]
    fastest = _FASTER * np.concatenate(moved).max(axis=0)
    fastest[fastest == 0.0] = np.inf
    return Region(centre, whiten, edge, lengths, mean, change, fastest, middle, reach)


def _features(past_u: Array, u: Array, y: Array, lengths: Sequence[int], usual: Array) -> Array:
    """Average the inputs over the samples up to each one, with `usual` (nu,) before the past
    window, and append the outputs there."""
    whole = np.concatenate([past_u, u])
    averages = [_average(whole, length, usual)[len(past_u) :] for length in lengths]
    return np.concatenate([*averages, y], axis=1)


def _changes(past_u: Array, u: Array, length: int, usual: Array) -> Array:
    """Root mean square (H, nu) of the input changes over the last `length` samples, with the mean
    square `usual` (nu,) before the past window."""
    whole = np.concatenate([past_u, u])
    squares = np.diff(whole, axis=0, prepend=whole[:1]) ** 2
    squares[0] = usual
    return np.sqrt(np.maximum(_average(squares, length, usual), 0.0))[len(past_u) :]


def _average(values: Array, length: int, before: Array) -> Array:
    """Moving average (N, n) over the `length` samples up to each one; `before` (n,) stands in for
    the samples before the first."""
    whole = np.concatenate([np.tile(before, (length - 1, 1)), values])
    total = np.concatenate([np.zeros((1, whole.shape[1])), np.cumsum(whole, axis=0)])
    return (total[length:] - total[:-length]) / length
