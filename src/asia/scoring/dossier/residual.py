"""Checks of the simulation residual, each for one likely cause."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from asia.data import Array
from asia.protocol import find_metric
from asia.scoring._correlation import QUANTILE, with_input, with_own_past
from asia.scoring._fit import fit_index, pooled
from asia.scoring.dossier.check import Cause, Check, CheckCurve, Verdict
from asia.scoring.dossier.records import SimulatedBlocks, listed, percent
from asia.scoring.dossier.regression import Explained, explained
from asia.scoring.dossier.regressors import Groups, groups

Columns = Callable[[Groups], list[Array]]

_CHANCE = 1e-4
# Least share of the residual's variance, and of the output's standard deviation, for a flag.
_SHARE, _SIZE = 0.05, 0.005
# Least share in repeated tests: under strongly coloured noise a single test has little power.
_AGAIN = 0.08
_FAIL_SHARE, _FAIL_SIZE = 0.25, 0.02
_PARTS = 20


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
            f"{percent(self.found.share)} of the residual's variance, "
            f"{percent(self.size)} of the output's standard deviation"
        )


def residual_checks(found: SimulatedBlocks) -> tuple[Check, ...]:
    """Fit, and dependence of the residual on inputs, time, amplitude and motion."""
    columns = [groups(found, output) for output in range(len(found.outputs))]
    return (
        check_fit(found),
        check_inputs(found, columns),
        check_whiteness(found),
        check_time(found, columns),
        check_amplitude(found, columns),
        check_motion(found, columns),
    )


def check_fit(found: SimulatedBlocks) -> Check:
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
    sentence = f"fit index in free run: {words}"
    if bad:
        sentence += "; below 0 % the mean of the output is more accurate"
        return Check("fit in free run", Verdict.FAIL, sentence, weight=0.5)
    return Check("fit in free run", Verdict.PASS, sentence)


def check_inputs(found: SimulatedBlocks, columns: Sequence[Groups]) -> Check:
    """Test the independence of residual and inputs, by the share that past inputs explain.

    The cross-correlations name the lags, with bands that hold for all of them together.
    """
    worst = _worst(found, columns, lambda g: g.inputs, lambda g: [x[:, :0] for x in g.inputs])
    pairs = len(found.inputs) * len(found.outputs)
    curves: list[CheckCurve] = []
    best, lags_of_best = (0.0, 0, 0), ""
    for output, name in enumerate(found.outputs):
        for number, other in enumerate(found.inputs):
            one = with_input(found.residuals(output), found.input(number))
            band = one.band * _wider(pairs * len(one.lags))
            lags = np.array(one.lags, dtype=np.float64)
            curves.append(CheckCurve(f"{name} with {other}", lags, one.values, band))
            past = lags >= 0
            peak = float(np.max(np.abs(one.values[past])) / max(band, 1e-300))
            if output == worst.output and peak > best[0]:
                best = (peak, output, number)
                lags_of_best = _range(lags[past], np.abs(one.values[past]), band)
    axes = ("lag of the input [samples]", "correlation [-]")
    if worst.verdict is Verdict.PASS or not lags_of_best:
        sentence = f"no residual depends on the past of an input ({worst.words()} at most)"
        return Check("inputs", Verdict.PASS, sentence, curves=tuple(curves), axes=axes)
    sentence = (
        f"the residual of {found.outputs[best[1]]} follows {found.inputs[best[2]]} at "
        f"{lags_of_best}: {Cause.DYNAMICS} ({worst.words()})"
    )
    return Check("inputs", worst.verdict, sentence, Cause.DYNAMICS, worst.alone,
                 tuple(curves), axes)  # fmt: skip


def check_whiteness(found: SimulatedBlocks) -> Check:
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
    words = f"largest correlation of a residual with its own past: {largest:.2f} ({name})"
    return Check("whiteness", Verdict.SHOWN, words, curves=tuple(curves),
                 axes=("lag [samples]", "correlation [-]"))  # fmt: skip


def check_time(found: SimulatedBlocks, columns: Sequence[Groups]) -> Check:
    """Test for a drift: the share that a slow function of time explains."""
    worst = _worst(found, columns, lambda g: g.time, _linear)
    curves = tuple(_along_time(found, k) for k in range(len(found.outputs)))
    axes = ("time in the record [s]", "mean residual over deviation [-]")
    if worst.verdict is Verdict.PASS:
        sentence = f"no residual drifts with time ({worst.words()} at most)"
        return Check("time", Verdict.PASS, sentence, curves=curves, axes=axes)
    sentence = f"the residual of {found.outputs[worst.output]} drifts with time: {Cause.DRIFT} "
    return Check("time", worst.verdict, f"{sentence}({worst.words()})", Cause.DRIFT,
                 worst.alone, curves, axes)  # fmt: skip


def check_amplitude(found: SimulatedBlocks, columns: Sequence[Groups]) -> Check:
    """Test for a missing static nonlinearity: the share that piecewise linear functions of the
    simulated output and of the inputs explain beyond linear dynamics."""
    worst = _worst(found, columns, lambda g: g.bends, _linear)
    curves = tuple(_against_amplitude(found, k) for k in range(len(found.outputs)))
    axes = ("simulated output over deviation [-]", "mean residual over deviation [-]")
    if worst.verdict is Verdict.PASS:
        sentence = f"no residual depends on the amplitude ({worst.words()} at most)"
        return Check("amplitude", Verdict.PASS, sentence, curves=curves, axes=axes)
    sentence = (
        f"the residual of {found.outputs[worst.output]} depends on the amplitude: {Cause.STATIC} "
        f"({worst.words()})"
    )
    return Check("amplitude", worst.verdict, sentence, Cause.STATIC, worst.alone,
                 curves, axes)  # fmt: skip


def check_motion(found: SimulatedBlocks, columns: Sequence[Groups]) -> Check:
    """Test for friction or hysteresis: the share that the signs of the output and of its rate
    explain beyond linear dynamics."""
    worst = _worst(found, columns, lambda g: g.turns, _linear)
    if worst.verdict is Verdict.PASS:
        sentence = f"no residual changes with the direction of motion ({worst.words()} at most)"
        return Check("motion", Verdict.PASS, sentence)
    sentence = (
        f"the residual of {found.outputs[worst.output]} changes at reversals of the motion: "
        f"{Cause.FRICTION} ({worst.words()})"
    )
    # With a long past the signs approximate linear dynamics as well: weigh by a short past.
    columns_of = columns[worst.output]
    e = [r[columns_of.reach :] for r in found.residuals(worst.output)]
    nothing = [x[:, :0] for x in columns_of.inputs]
    recent = explained(e, nothing, columns_of.recent_turns).share
    weight = max(worst.found.share, recent)
    return Check("motion", worst.verdict, sentence, Cause.FRICTION, weight)


def _linear(columns: Groups) -> list[Array]:
    pairs = zip(columns.inputs, columns.simulated, strict=True)
    return [np.concatenate(pair, axis=1) for pair in pairs]


def _worst(
    found: SimulatedBlocks, columns: Sequence[Groups], added: Columns, base: Columns
) -> _Found:
    """Return the output whose residual variance the regressors explain best, flagged ones first."""
    each: list[_Found] = []
    for output, (group, deviation) in enumerate(zip(columns, found.deviation, strict=True)):
        e = [r[group.reach :] for r in found.residuals(output)]
        one = explained(e, base(group), added(group))
        nothing = [x[:, :0] for x in group.inputs]
        alone = explained(e, nothing, added(group)).share
        each.append(_Found(output, one, one.size / float(deviation), alone))
    return max(each, key=lambda f: (f.verdict is not Verdict.PASS, f.found.share))


def _wider(tests: int) -> float:
    """Return the factor that widens a 99 % band of one value to a band of `tests` values
    together."""
    from scipy.special import ndtri  # only where statistics are asked for

    return float(ndtri(1.0 - 0.005 / tests)) / QUANTILE


def _range(lags: Array, sizes: Array, band: float) -> str:
    """The lags around the largest value that are beyond the band; "" where none is."""
    peak = int(np.argmax(sizes))
    if sizes[peak] <= band:
        return ""
    first = last = peak
    while first > 0 and sizes[first - 1] > band:
        first -= 1
    while last < len(sizes) - 1 and sizes[last + 1] > band:
        last += 1
    if first == last:
        return f"lag {lags[first]:.0f}"
    return f"lags {lags[first]:.0f} to {lags[last]:.0f}"


def _along_time(found: SimulatedBlocks, output: int) -> CheckCurve:
    e = np.concatenate(found.residuals(output)) / found.deviation[output]
    t = np.concatenate([b.start + np.arange(len(b.y)) for b in found.blocks]) * found.sampling_time
    return _means(found.outputs[output], t.astype(np.float64), e)


def _against_amplitude(found: SimulatedBlocks, output: int) -> CheckCurve:
    deviation = found.deviation[output]
    e = np.concatenate(found.residuals(output)) / deviation
    y_hat = np.concatenate([b.y_hat[:, output] for b in found.blocks]) / deviation
    return _means(found.outputs[output], y_hat, e)


def _means(name: str, x: Array, e: Array) -> CheckCurve:
    """Means over parts of as many samples, in the order of x."""
    order = np.array_split(np.argsort(x, kind="stable"), min(_PARTS, len(x)))
    return CheckCurve(
        name, np.array([x[o].mean() for o in order]), np.array([e[o].mean() for o in order])
    )
