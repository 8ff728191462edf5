"""Checks of the residual: which missing effect would explain it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from asia.data.trajectory import Array
from asia.judge.scoring.checks.check import Cause, Check, CheckCurve, Verdict
from asia.judge.scoring.checks.validation_data import (
    SimulatedSegments,
    ValidationData,
    listed,
    percent,
)
from asia.judge.scoring.outcome import fit_index
from asia.judge.scoring.residuals import QUANTILE, pooled, with_input, with_own_past
from asia.problem.metrics import find_metric

# F test of regressors of a coloured residual, after whitening.
#
# Source: Cochrane and Orcutt, Application of least squares regression to relationships containing
# auto-correlated error terms, JASA 44 (1949), with an autoregression of several lags.


_ORDER = 8
_MOST_ROWS = 20_000
_REGRESSION_PARTS = 6
_RANK = 1e-9


@dataclass(frozen=True)
class Explained:
    """Contribution of regressors beyond others."""

    chance: float
    """Probability that independent columns explain as much."""
    share: float
    """Share of the variance of the residual, corrected for the number of columns."""
    size: float
    """Standard deviation of the explained part, in the unit of the residual."""
    again: float
    """The share that they explain in each sixth of the samples with gains of the others; negative
    where chance explains nothing again, and 0 unless nearly every sixth has a gain."""


def explained(
    residual: Sequence[Array], base: Sequence[Array], added: Sequence[Array]
) -> Explained:
    """Test the contribution of `added` to a residual beyond `base` and a constant.

    Args:
        residual: (n,), one a block
        base, added: (n, columns), one a block
    """
    lengths = [len(e) for e in residual]
    if sum(lengths) > _MOST_ROWS:
        # Blocks, evenly spread, or the start of each where there are few.
        many = max(1, min(len(residual), _MOST_ROWS // max(lengths)))
        places = np.linspace(0, len(residual) - 1, many).round().astype(int).tolist()
        each = _MOST_ROWS // many
        residual, base, added = ([p[k][:each] for k in places] for p in (residual, base, added))
        lengths = [len(e) for e in residual]
    e = np.concatenate(list(residual))
    constant = np.ones((len(e), 1))
    x0 = _scaled(np.concatenate([constant, np.concatenate(list(base))], axis=1))
    x1 = _scaled(np.concatenate(list(added)))
    x = np.concatenate([x0, x1], axis=1)
    if x1.shape[1] == 0 or len(e) <= 2 * x.shape[1] or not np.any(e):
        return Explained(1.0, 0.0, 0.0, 0.0)
    bases = _bases(x0, x1)
    left0, left = _left(e, bases[0]), _left(e, bases[1])
    size = float(np.std(left0 - left))
    free = max(len(e) - bases[1].shape[1], 1)
    loss = float(left0 @ left0)
    kept = (float(left @ left) / free) / max(loss / max(len(e) - x0.shape[1], 1), 1e-300)
    filters = _autoregression(left, lengths)
    white_e, white0, white1 = (_filtered(v, filters, lengths) for v in (e[:, None], x0, x1))
    chance = _f_chance(white_e[:, 0], *_bases(white0, white1))
    total = max(float(np.sum((e - e.mean()) ** 2)), 1e-300)
    share = max(0.0, 1.0 - kept) * min(loss / total, 1.0)
    return Explained(chance, share, size, _again(e, *bases))


def _bases(x0: Array, x1: Array) -> tuple[Array, Array]:
    """Orthonormal columns (n, r) that span those of x0, and those of both; the first ones of the
    second are those of the first. All fits to parts of the rows are then small and well posed."""
    base = _spanned(x0, x0)
    left = x1 - base @ (base.T @ x1)
    left -= base @ (base.T @ left)
    return base, np.concatenate([base, _spanned(left, x1)], axis=1)


def _spanned(columns: Array, before: Array) -> Array:
    """Return a basis of columns (n, c), whose values were `before` until others were projected
    out."""
    from scipy.linalg import qr  # only where statistics are asked for

    q, r = np.linalg.qr(columns)
    # Pivots are looked for in the small factor alone, which is much faster.
    found: Any = qr(r, pivoting=True)
    turned, ordered = found[:2]
    size = _RANK * float(np.sqrt(np.max(np.sum(before * before, axis=0), initial=0.0)))
    return q @ np.asarray(turned)[:, : int(np.sum(np.abs(np.diagonal(ordered)) > size))]


def _left(e: Array, basis: Array) -> Array:
    """Return the residual of a projection on the columns."""
    return e - basis @ (basis.T @ e)


def _again(e: Array, base: Array, whole: Array) -> float:
    sums, total, better = [0.0, 0.0], 0.0, 0
    for part in np.array_split(np.arange(len(e)), _REGRESSION_PARTS):
        losses: list[float] = []
        for basis in (base, whole):
            own, many = basis[part], basis.shape[1]
            # Without the part: what it adds is taken off, and a column that is in it alone is not
            # known.
            others = np.eye(many) - own.T @ own
            gains = np.linalg.pinv(others, rcond=_RANK, hermitian=True) @ (
                basis.T @ e - own.T @ e[part]
            )
            left = e[part] - own @ gains
            losses.append(float(left @ left))
        sums = [a + b for a, b in zip(sums, losses, strict=True)]
        better += losses[1] < losses[0]
        total += float(np.sum((e[part] - e.mean()) ** 2))
    return (sums[0] - sums[1]) / max(total, 1e-300) if better >= _REGRESSION_PARTS - 1 else 0.0


def _f_chance(e: Array, base: Array, whole: Array) -> float:
    from scipy.special import fdtrc  # only where statistics are asked for

    more, free = whole.shape[1] - base.shape[1], len(e) - whole.shape[1]
    if more <= 0 or free <= 0:
        return 1.0
    left0, left = _left(e, base), _left(e, whole)
    rest = float(left @ left)
    gain = float(left0 @ left0) - rest
    return float(fdtrc(more, free, max(gain, 0.0) / more / max(rest / free, 1e-300)))


def _autoregression(e: Array, lengths: Sequence[int]) -> Array:
    """Coefficients (order,) of e(t) on its own past, over all blocks; the order is shorter in short
    blocks."""
    order = max(0, min(_ORDER, min(lengths) // 4))
    rows, targets = [], []
    for part in _split(e, lengths):
        if len(part) > order > 0:
            lagged = np.lib.stride_tricks.sliding_window_view(part, order)[:-1, ::-1]
            rows.append(lagged)
            targets.append(part[order:])
    if not rows:
        return np.zeros(0)
    x, y = np.concatenate(rows), np.concatenate(targets)
    # A little ridge keeps a residual that is zero harmless.
    ridge = 1e-9 * float(np.sum(x * x)) / x.shape[1] + 1e-300
    return np.linalg.solve(x.T @ x + ridge * np.eye(order), x.T @ y)


def _filtered(x: Array, filters: Array, lengths: Sequence[int]) -> Array:
    """Whiten each column by subtracting its prediction from the past; the first samples of each
    block are dropped."""
    order = len(filters)
    parts: list[Array] = []
    for part in _split(x, lengths):
        left = part[order:].copy()
        for lag, value in enumerate(filters, start=1):
            left -= value * part[order - lag : len(part) - lag]
        parts.append(left)
    return np.concatenate(parts)


def _split(x: Array, lengths: Sequence[int]) -> list[Array]:
    return np.split(x, np.cumsum(lengths)[:-1])


def _scaled(x: Array) -> Array:
    """Columns of size 1, without those that do not move but the first constant."""
    size = np.sqrt(np.mean(x * x, axis=0))
    moves = np.ptp(x, axis=0) > 1e-9 * np.maximum(size, 1e-300)
    if x.shape[1]:
        moves[0] |= bool(np.all(x[:, 0] == 1.0))
    return x[:, moves] / size[moves]


# Regressors of residuals, one group for each kind of missing dynamics.
#
# Each group of columns is for one block. All columns of a block have the same rows: the samples
# from `reach` on, so that each has its past.


# First and last lag of the moving averages that represent the past of a signal.
_LAGS = ((0, 0), (1, 1), (2, 2), (3, 3), (4, 5), (6, 8), (9, 12), (13, 18), (19, 27), (28, 40))
# The effect of a switching force lasts as long as the memory of the system.
_LONG_LAGS = (*_LAGS, (41, 60), (61, 80))
_FEW_LAGS = ((0, 0), (1, 1), (2, 3), (4, 7), (8, 15))
_MOST_INPUTS_BENT = 4
# Beyond these quantiles of a signal a bend may begin.
_BENDS = (0.15, 0.3, 0.7, 0.85)
_STILL = 0.05


@dataclass(frozen=True)
class Groups:
    """The columns for one output, one array (n, columns) a block."""

    reach: int
    """Samples that are left out at the start of each block."""
    inputs: list[Array]
    simulated: list[Array]
    bends: list[Array]
    """Bends of the simulated output and of the inputs."""
    turns: list[Array]
    """Signs of the simulated output and of its rate, and their past."""
    recent_turns: list[Array]
    """The same, with a short past."""
    rates: list[Array]
    """Smooth odd functions of the rate of the simulated output, and their past."""
    time: list[Array]
    """Slow functions of the time in the record."""


def groups(found: SimulatedSegments, output: int) -> Groups:
    """The columns for the residual of one output."""
    blocks = found.blocks
    most = max(2, found.shortest // 6)
    lags = [pair for pair in _LAGS if pair[1] <= most]
    few = [pair for pair in _FEW_LAGS if pair[1] <= most]
    long = [pair for pair in _LONG_LAGS if pair[1] <= most]
    reach = long[-1][1]
    y_hat = [b.y_hat[:, output : output + 1] for b in blocks]
    rate = [np.gradient(v, axis=0) for v in y_hat]
    bent = [_bends(y_hat)]
    if len(found.inputs) <= _MOST_INPUTS_BENT:
        for number in range(len(found.inputs)):
            each = _bends([b.u[:, number : number + 1] for b in blocks])
            bent.append([_past(v, few) for v in each])
    signs = [_signs(y_hat), _signs(rate)]
    end = max(b.start + len(b.y) for b in blocks)
    return Groups(
        reach,
        [_past(b.u, lags)[reach:] for b in blocks],
        [_past(v, few)[reach:] for v in y_hat],
        [np.concatenate(parts, axis=1)[reach:] for parts in zip(*bent, strict=True)],
        _pasts(signs, long, reach),
        _pasts(signs, few, reach),
        [_past(v, few)[reach:] for v in _odd_powers(rate)],
        # In samples from the start of the record.
        [(b.start + np.arange(len(b.y), dtype=np.float64))[reach:, None] / end for b in blocks],
    )


def _pasts(
    signals: Sequence[Sequence[Array]], lags: Sequence[tuple[int, int]], reach: int
) -> list[Array]:
    """The past of several signals (n, c), one array a block."""
    together = zip(*signals, strict=True)
    return [np.concatenate([_past(v, lags) for v in each], axis=1)[reach:] for each in together]


def _past(x: Array, lags: Sequence[tuple[int, int]]) -> Array:
    """Average each column of (n, c) over the lags, (n, c * lags); the first value fills the time
    before it."""
    far = lags[-1][1]
    whole = np.concatenate([np.repeat(x[:1], far, axis=0), x])
    total = np.concatenate([np.zeros((1, x.shape[1])), np.cumsum(whole, axis=0)])
    ends = np.arange(len(x)) + far + 1
    means = [(total[ends - a] - total[ends - b - 1]) / (b - a + 1) for a, b in lags]
    return np.concatenate(means, axis=1)


def _bends(signal: Sequence[Array]) -> list[Array]:
    """Return the excess of one signal, (n, 1) a block, over its quantiles."""
    edges = np.quantile(np.concatenate(list(signal)), _BENDS)
    low, high = edges[: len(edges) // 2], edges[len(edges) // 2 :]
    return [np.concatenate([np.minimum(v - low, 0), np.maximum(v - high, 0)], 1) for v in signal]


def _odd_powers(signal: Sequence[Array]) -> list[Array]:
    """z|z| and z^3 of one signal, (n, 1) a block."""
    size = float(np.concatenate(list(signal)).std()) or 1.0
    scaled = [v / size for v in signal]
    return [np.concatenate([z * np.abs(z), z**3], axis=1) for z in scaled]


def _signs(signal: Sequence[Array]) -> list[Array]:
    """The sign of one signal, softened where it is small."""
    size = float(np.concatenate(list(signal)).std()) or 1.0
    return [np.tanh(v / (_STILL * size)) for v in signal]


# Checks of the simulation residual, each for one likely cause.

Columns = Callable[[Groups], list[Array]]

_CHANCE = 1e-4
# Least share of the residual's variance, and of the output's standard deviation, for a flag.
_SHARE, _SIZE = 0.05, 0.005
# Least share in repeated tests: under strongly coloured noise a single test has little power.
_AGAIN = 0.08
_FAIL_SHARE, _FAIL_SIZE = 0.25, 0.02
_PARTS = 20
_SHARP = 0.4
"""Least part of what signs explain that smooth functions do not: 0.54 and more with dry friction in
`benchmarks/validation/defects.py`, 0.25 and less in a sound model of a chemical reactor."""


@dataclass(frozen=True)
class _Found:
    """Contribution of one group of columns, for the output that it explains best."""

    output: int
    found: Explained
    size: float
    """Size relative to the standard deviation of the output."""
    alone: float
    """The share that the columns explain without any others."""

    @property
    def verdict(self) -> Verdict:
        """Chance and small sizes pass."""
        one = self.found
        by_chance = one.chance > _CHANCE and one.again < _AGAIN
        if by_chance or one.share < _SHARE or self.size < _SIZE:
            return Verdict.PASS
        grave = one.share >= _FAIL_SHARE and self.size >= _FAIL_SIZE
        return Verdict.FAIL if grave else Verdict.DOUBT

    def words(self) -> str:
        """Describe the size of the contribution."""
        return (
            f"{percent(self.found.share)} of the residual's variance explained, "
            f"{percent(self.size)} of the output's standard deviation"
        )


def residual_checks(data: ValidationData) -> tuple[Check, ...]:
    """Fit, and dependence of the residual on inputs, time, amplitude and motion."""
    found = data.simulations
    columns = [groups(found, output) for output in range(len(found.outputs))]
    return (
        check_fit(found),
        check_inputs(found, columns),
        check_whiteness(found),
        check_time(found, columns),
        check_amplitude(found, columns),
        check_motion(found, columns),
    )


def check_fit(found: SimulatedSegments) -> Check:
    """Fit index and RMSE of the free run of each output."""
    y, y_hat = pooled([b.y for b in found.blocks]), pooled([b.y_hat for b in found.blocks])
    fits, rmse = fit_index(y, y_hat), find_metric("rmse").values(y, y_hat)
    words = listed(
        [
            f"{name} {fit:.1f} % (RMSE {error:.3g})"
            for name, fit, error in zip(found.outputs, fits.tolist(), rmse.tolist(), strict=True)
        ]
    )
    finite = fits[np.isfinite(fits)]
    bad = bool(len(finite)) and float(finite.min()) <= 0.0
    sentence = f"fit index of the simulation: {words}"
    if bad:
        sentence += "; below 0 % the mean of the output has a smaller error"
        return Check("fit in free run", Verdict.FAIL, sentence, weight=1.5)
    return Check("fit in free run", Verdict.PASS, sentence)


def check_inputs(found: SimulatedSegments, columns: Sequence[Groups]) -> Check:
    """Test the independence of residual and inputs, by the share that past inputs explain.

    The cross-correlations name the lags, with bands that hold for all of them together.
    """
    from scipy.special import ndtri  # only where statistics are asked for

    worst = _worst(found, columns, lambda g: g.inputs, _nothing)
    pairs = len(found.inputs) * len(found.outputs)
    curves: list[CheckCurve] = []
    largest, follows = 0.0, ""
    for output, name in enumerate(found.outputs):
        for number, other in enumerate(found.inputs):
            one = with_input(found.residuals(output), found.input(number))
            # From a 99 % band of one value to one of all together.
            wider = float(ndtri(1.0 - 0.005 / (pairs * len(one.lags)))) / QUANTILE
            band = one.band * wider
            lags = np.array(one.lags, dtype=np.float64)
            curves.append(CheckCurve(f"{name} with {other}", lags, one.values, band))
            past = lags >= 0
            peak = float(np.max(np.abs(one.values[past])) / max(band, 1e-300))
            if output == worst.output and peak > largest:
                largest = peak
                where = _range(lags[past], np.abs(one.values[past]), band)
                follows = f"follows {other} at {where}" if where else ""
    axes = ("lag of the input [samples]", "correlation [-]")
    return _judged(
        "inputs", found, worst, "depends on past inputs", follows, Cause.DYNAMICS,
        worst.alone, tuple(curves), axes,
    )  # fmt: skip


def check_whiteness(found: SimulatedSegments) -> Check:
    """Show the autocorrelation of each residual; it is not judged, because a simulation residual
    need not be white."""
    curves: list[CheckCurve] = []
    largest, name = 0.0, found.outputs[0]
    for output, label in enumerate(found.outputs):
        one = with_own_past(found.residuals(output))
        curves.append(CheckCurve(label, np.array(one.lags, dtype=np.float64), one.values, one.band))
        peak = float(np.max(np.abs(one.values[1:])))
        if peak > largest:
            largest, name = peak, label
    words = f"largest autocorrelation of a residual: {largest:.2f} ({name})"
    return Check("whiteness", Verdict.SHOWN, words, curves=tuple(curves),
                 axes=("lag [samples]", "correlation [-]"))  # fmt: skip


def check_time(found: SimulatedSegments, columns: Sequence[Groups]) -> Check:
    """Test for a drift: the share that a slow function of time explains."""
    worst = _worst(found, columns, lambda g: g.time, _linear)
    t = np.concatenate([b.start + np.arange(len(b.y)) for b in found.blocks]) * found.sampling_time
    curves = tuple(_means(found, k, t.astype(np.float64)) for k in range(len(found.outputs)))
    axes = ("time in the record [s]", "mean residual / standard deviation [-]")
    words = "drifts with time"
    return _judged("time", found, worst, words, words, Cause.DRIFT, worst.alone, curves, axes)


def check_amplitude(found: SimulatedSegments, columns: Sequence[Groups]) -> Check:
    """Test for a missing static nonlinearity: the share that piecewise linear functions of the
    simulated output and of the inputs explain beyond linear dynamics."""
    worst = _worst(found, columns, lambda g: g.bends, _linear)
    y_hat = np.concatenate([b.y_hat for b in found.blocks]) / found.deviation
    curves = tuple(_means(found, k, y_hat[:, k]) for k in range(len(found.outputs)))
    axes = ("simulated output / standard deviation [-]", "mean residual / standard deviation [-]")
    words = "depends on the amplitude"
    return _judged("amplitude", found, worst, words, words, Cause.STATIC, worst.alone, curves, axes)


def check_motion(found: SimulatedSegments, columns: Sequence[Groups]) -> Check:
    """Test for friction, play or hysteresis: the share that the signs of the output and of its rate
    explain beyond linear dynamics. Where smooth functions of the rate, which any nonlinear process
    has, explain most of it as well, only what signs explain beyond these counts."""
    worst = _worst(found, columns, lambda g: g.turns, _linear)
    weight = worst.found.share
    if worst.verdict is not Verdict.PASS:
        group = columns[worst.output]
        e = [r[group.reach :] for r in found.residuals(worst.output)]
        # With a long past the signs approximate linear dynamics as well: weigh by a short past.
        weight = max(weight, explained(e, _nothing(group), group.recent_turns).share)
        beyond = explained(e, _linear_and_smooth(group), group.turns).share
        if beyond < _SHARP * worst.found.share:
            worst = _worst(found, columns, lambda g: g.turns, _linear_and_smooth)
    words = "depends on the direction in which the output moves"
    return _judged(
        "motion", found, worst, words, words, Cause.FRICTION, weight,
    )  # fmt: skip


def _judged(
    name: str,
    found: SimulatedSegments,
    worst: _Found,
    passing: str,
    flagged: str,
    cause: Cause,
    weight: float,
    curves: tuple[CheckCurve, ...] = (),
    axes: tuple[str, str] = ("", ""),
) -> Check:
    """Check for one cause; no residual does `passing`, or that of the worst output does `flagged`,
    "" for a check that passes."""
    if worst.verdict is Verdict.PASS or not flagged:
        sentence = f"no residual significantly {passing} (at most {worst.words()})"
        return Check(name, Verdict.PASS, sentence, curves=curves, axes=axes)
    sentence = f"the residual of {found.outputs[worst.output]} {flagged}: {cause} ({worst.words()})"
    return Check(name, worst.verdict, sentence, cause, weight, curves, axes)


def _linear(columns: Groups) -> list[Array]:
    pairs = zip(columns.inputs, columns.simulated, strict=True)
    return [np.concatenate(pair, axis=1) for pair in pairs]


def _linear_and_smooth(columns: Groups) -> list[Array]:
    pairs = zip(_linear(columns), columns.rates, strict=True)
    return [np.concatenate(pair, axis=1) for pair in pairs]


def _nothing(columns: Groups) -> list[Array]:
    return [x[:, :0] for x in columns.inputs]


def _worst(
    found: SimulatedSegments, columns: Sequence[Groups], added: Columns, base: Columns
) -> _Found:
    """Return the output whose residual variance the regressors explain best, flagged ones first."""
    each: list[_Found] = []
    for output, (group, deviation) in enumerate(zip(columns, found.deviation, strict=True)):
        e = [r[group.reach :] for r in found.residuals(output)]
        one = explained(e, base(group), added(group))
        alone = explained(e, _nothing(group), added(group)).share
        each.append(_Found(output, one, one.size / float(deviation), alone))
    return max(each, key=lambda f: (f.verdict is not Verdict.PASS, f.found.share))


def _range(lags: Array, sizes: Array, band: float) -> str:
    """The lags around the largest value that are beyond the band; "" where none is."""
    first = last = int(np.argmax(sizes))
    if sizes[first] <= band:
        return ""
    while first > 0 and sizes[first - 1] > band:
        first -= 1
    while last < len(sizes) - 1 and sizes[last + 1] > band:
        last += 1
    if first == last:
        return f"lag {lags[first]:.0f}"
    return f"lags {lags[first]:.0f} to {lags[last]:.0f}"


def _means(found: SimulatedSegments, output: int, x: Array) -> CheckCurve:
    """Mean residuals of one output over parts of as many samples, in the order of x."""
    e = np.concatenate(found.residuals(output)) / found.deviation[output]
    order = np.array_split(np.argsort(x, kind="stable"), min(_PARTS, len(x)))
    means, places = ([v[o].mean() for o in order] for v in (e, x))
    return CheckCurve(found.outputs[output], np.array(places), np.array(means))
