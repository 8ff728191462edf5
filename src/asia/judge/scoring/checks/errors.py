"""Checks of the errors: growth, overfit, bands, region of validity."""

from collections.abc import Sequence

import numpy as np
from scipy.signal import lfilter

from asia.data.trajectory import Array
from asia.judge.scoring.bands import Region, independent_errors
from asia.judge.scoring.checks.check import ALARM_RATE, Cause, Check, CheckCurve, Verdict
from asia.judge.scoring.checks.validation_data import (
    SimulatedSegments,
    ValidationData,
    listed,
    percent,
)

# Errors some steps after a start from measured samples, against holding the last output.


_NAME, _AXES = "steps ahead", ("steps after the start", "normalised error [-]")
_WORST_TENTH = 0.9


def check_steps_ahead(model: Array, hold: Array | None, deviation: Array) -> Check:
    """model, hold (n, K, ny): errors of n simulations that begin anew, and of the last measured
    output, at steps 1 to K; hold is None where a simulation begins without measured outputs;
    deviation (ny,) of the outputs."""
    size = _sizes(model, deviation)
    each = np.sqrt(np.mean((model / deviation) ** 2, axis=2))
    steps = np.arange(1, model.shape[1] + 1, dtype=np.float64)
    curves = [
        CheckCurve("model", steps, size),
        CheckCurve("model, worst tenth", steps, np.quantile(each, _WORST_TENTH, axis=0)),
    ]
    shown = dict.fromkeys(k for k in (1, 5, 20, len(steps)) if k <= len(steps))
    words = ", ".join(f"{size[k - 1]:.3g} at step {k}" for k in shown)
    whole = np.sqrt(np.mean(each**2, axis=1))
    middle, far = np.quantile(whole, (0.5, _WORST_TENTH)).tolist()
    sentence = (
        f"normalised error after {len(whole)} starts from measured samples: {words}; over all "
        f"steps, median {middle:.3g}, 90 % quantile {far:.3g}, maximum {float(whole.max()):.3g}"
    )
    if hold is None:
        return Check(_NAME, Verdict.SHOWN, f"{sentence}; no output is measured before the "
                     "first sample", curves=tuple(curves), axes=_AXES)  # fmt: skip
    held = _sizes(hold, deviation)
    curves.append(CheckCurve("last output", steps, held))
    worse = bool(size[-1] >= held[-1])
    if worse:
        sentence += f"; holding the last output has {held[-1]:.3g} at step {len(steps)}"
    verdict = Verdict.DOUBT if worse else Verdict.PASS
    return Check(_NAME, verdict, sentence, None, 0.2, tuple(curves), _AXES)


def no_steps_ahead(why: str) -> Check:
    """Return a check that does not apply, where no window starts anew."""
    return Check(_NAME, Verdict.ABSENT, f"does not apply: {why}")


def _sizes(errors: Array, deviation: Array) -> Array:
    return np.sqrt(np.mean((errors / deviation) ** 2, axis=(0, 2)))


# Check of the error on held-out against training records, and its likely cause.


# Mean held-out error over mean training error; and the minimum in every fold.
_DOUBT, _FAIL, _EVERY = 1.5, 2.5, 1.2
# Share of the held-out residual that a correction of gain and slow dynamics explains: above the
# first, parameters drift; below the second, the model fits noise; between them no cause is named.
_DRIFTS, _NOISE = 0.45, 0.3
# Time constants of the correction, in samples.
_MEMORIES = (4.0, 16.0)


def check_overfit(
    train: Sequence[float],
    held_out: Sequence[float],
    simulations: SimulatedSegments,
    apart: Sequence[str] = (),
    parameters: int | None = None,
) -> Check:
    """Compare the error on held-out records with that on training records.

    The ratio of their squares is judged by an F distribution, with as many degrees of freedom as
    there are independent errors.

    Args:
        train, held_out: normalised error of each fold's model on its training records, and on
            its held-out ones
        simulations: simulations of the held-out records
        apart: names of the parameters that differ between the fold models by more than noise
            explains
        parameters: count of the numbers in the model; None where it is not known
    """
    from scipy.special import fdtrc

    a, b = np.array(train), np.array(held_out)
    ratio = float(b.mean() / max(float(a.mean()), 1e-300))
    least = float(np.min(b / np.maximum(a, 1e-300)))
    folds = np.arange(1, len(a) + 1, dtype=np.float64)
    curves = (CheckCurve("training", folds, a), CheckCurve("held out", folds, b))
    count = _independent(simulations)
    words = (
        f"on held-out samples the error is {ratio:.2f} times the training error ({b.mean():.3g} "
        f"and {a.mean():.3g}; {count:.0f} independent errors)"
    )
    axes = ("fold", "normalised error [-]")
    trained = max(count * (len(a) - 1.0) / len(a), 1.0)
    by_chance = float(fdtrc(count, trained, ratio**2)) > ALARM_RATE
    if ratio < _DOUBT or least < _EVERY or by_chance:
        words += ", which is chance" if by_chance and ratio >= _DOUBT else ""
        return Check("held-out error", Verdict.PASS, words, curves=curves, axes=axes)
    verdict = Verdict.FAIL if ratio >= _FAIL else Verdict.DOUBT
    cause, why = _cause(simulations, apart, ratio, (count, trained), parameters)
    return Check("held-out error", verdict, f"{words}: {why}", cause,
                 1.0 - 1.0 / ratio, curves, axes)  # fmt: skip


def _independent(found: SimulatedSegments) -> float:
    """Number of independent held-out errors, mean over the outputs."""
    each = [independent_errors([found.residuals(k)]) for k in range(len(found.outputs))]
    return max(sum(each) / len(each), 1.0)


def _cause(
    found: SimulatedSegments,
    apart: Sequence[str],
    ratio: float,
    counts: tuple[float, float],
    parameters: int | None,
) -> tuple[Cause | None, str]:
    """The cause of a larger held-out error, and the evidence for it."""
    from scipy.special import fdtri

    if apart:
        verb = "differs" if len(apart) == 1 else "differ"
        return Cause.PARAMETERS, (
            f"{Cause.PARAMETERS}, or an effect is missing ({listed(apart)} {verb} between the "
            "folds by more than noise explains)"
        )
    share = _corrected(found)
    evidence = "" if share is None else (
        f"a different gain and slow dynamics for each part explain {percent(share)} of the residual"
    )  # fmt: skip
    if share is not None and share >= _DRIFTS:
        return Cause.PARAMETERS, f"{Cause.PARAMETERS} ({evidence})"
    if parameters is None:
        return None, f"its cause is not known ({evidence or 'the parts are too short'})"
    # Least squares with p parameters for n errors: held-out over training errors is n / (n - p).
    held, trained = counts
    free = trained - parameters
    most = np.inf
    if free > 0:
        most = trained / free * float(np.sqrt(fdtri(held, trained, 1.0 - ALARM_RATE)))
    if ratio > most:
        return None, (
            f"the parts of the records differ; {parameters} fitted numbers explain a ratio of "
            f"{most:.2f} at most" + (f" ({evidence})" if evidence else "")
        )
    if share is None or share <= _NOISE:
        few = f"{parameters} fitted numbers for {trained:.0f} independent errors"
        return Cause.OVERFIT, (
            f"{Cause.OVERFIT}, because it has too many parameters or too few samples ({few})"
        )
    return None, (
        f"the system drifts, or the model has too many parameters for its records ({evidence})"
    )


def _corrected(found: SimulatedSegments) -> float | None:
    """Return the share of the held-out residual that few regressors explain in the other half of
    the same block.

    The regressors are the simulated outputs and their first-order lags. Fitted noise is spread over
    more directions. None where the blocks are too short.
    """
    before = after = 0.0
    for block in found.blocks:
        # Regressors (H, columns) of a change of parameters.
        signals = block.y_hat - block.y_hat.mean(axis=0)
        signals = signals / np.maximum(signals.std(axis=0), 1e-300)
        lagged = [
            np.asarray(lfilter([1.0 - pole], [1.0, -pole], signals, axis=0))
            for pole in (float(np.exp(-1.0 / memory)) for memory in _MEMORIES)
        ]
        columns = np.concatenate([np.ones((len(signals), 1)), signals, *lagged], axis=1)
        half = len(columns) // 2
        if half < 5 * columns.shape[1]:
            continue
        e = block.residual / found.deviation
        parts = (slice(0, half), slice(half, None))
        for fit, judge in (parts, parts[::-1]):
            gains = np.linalg.lstsq(columns[fit], e[fit], rcond=1e-8)[0]
            before += float((e[judge] ** 2).sum())
            after += float(((e[judge] - columns[judge] @ gains) ** 2).sum())
    return max(0.0, 1.0 - after / before) if before > 0 else None


# Check of the coverage of the output bands.


_MOST_NAMED = 3


def check_bands(
    held: Array, independent: Array, outputs: Sequence[str], level: float, withdrawn: Sequence[str]
) -> Check:
    """Check the share of the samples that bands hold which these samples did not make.

    Bands that hold their level hold less of few independent samples by chance: the binomial
    distribution, for as many outputs as there are (Bonferroni).

    Args:
        held: of each output (ny,), the share of the measured samples within the bands
        independent: number of independent errors of each output (ny,)
        withdrawn: the reason why there is no band, one an output; "" where there is one
    """
    from scipy.stats import binom  # only where statistics are asked for

    for name, reason in zip(outputs, withdrawn, strict=True):
        if reason:
            sentence = f"the output bands of {name} are withdrawn: {reason}"
            return Check("output bands", Verdict.FAIL, sentence, weight=1.0 - level)
    each = sorted(zip(held.tolist(), outputs, strict=True))
    words = ", ".join(f"{name} {percent(share)}" for share, name in each[:_MOST_NAMED])
    rest = " at least" if len(each) > _MOST_NAMED else ""
    sentence = f"{percent(level)} output bands contained{rest}: {words}"
    count = np.maximum(np.round(independent), 1.0)
    chance = np.asarray(binom.cdf(np.round(held * count), count, level))
    verdict = Verdict.FAIL if chance.min() < ALARM_RATE / len(outputs) else Verdict.PASS
    return Check("output bands", verdict, sentence, weight=max(0.0, level - each[0][0]))


def no_bands(reason: str) -> Check:
    """Return a check that does not apply, where a fold model does not simulate the record."""
    return Check("output bands", Verdict.ABSENT, f"does not apply: {reason}")


# Check of the similarity of samples to the training records.

_REGION_DOUBT, _REGION_FAIL = 0.1, 0.5


def check_region(found: SimulatedSegments, region: Region) -> Check:
    """The share of samples outside the region of validity; the edge is at 1."""
    distances = [region.distance(b.u[:0], b.u, b.y_hat) for b in found.blocks]
    every = np.concatenate(distances)
    share = float(np.mean(every > 1.0))
    first = next((k for k, d in enumerate(distances) if (d > 1.0).any()), None)
    curves = (CheckCurve("distance", np.arange(len(every), dtype=np.float64), every),)
    words = f"{percent(share)} of the samples are outside the region of validity"
    if first is not None and share > _REGION_DOUBT:
        block = found.blocks[first]
        begin = block.start + int(np.argmax(distances[first] > 1.0))
        words += f", first at {begin * found.sampling_time:.4g} s"
    verdict = _verdict(share, _REGION_DOUBT, _REGION_FAIL)
    return Check("region of validity", verdict, words, None, share / 2.0, curves,
                 ("sample", "distance / distance of the edge [-]"))  # fmt: skip


def _verdict(value: float, doubt: float, fail: float) -> Verdict:
    if value > fail:
        return Verdict.FAIL
    return Verdict.DOUBT if value > doubt else Verdict.PASS


# The sample that carries most of the error.


_ALONE = 0.2
"""Share of the squared error that one sample of many may carry."""


def check_largest_error(data: ValidationData) -> Check:
    """Name the sample with the largest error by record, row and time, with its share of the squared
    error of all outputs."""
    found = data.simulations
    errors = [((b.y - b.y_hat) / found.deviation) ** 2 for b in found.blocks]
    total = float(sum(np.nansum(e) for e in errors))
    if not total > 0 or not np.isfinite(total):
        return Check("largest error", Verdict.ABSENT, "does not apply: there is no error")
    k = int(np.argmax([np.nanmax(e, initial=0.0) for e in errors]))
    block, error = found.blocks[k], np.nan_to_num(errors[k])
    row, output = (int(i) for i in np.unravel_index(int(np.argmax(error)), error.shape))
    share = float(error[row, output]) / total
    number = block.start + row
    name = found.records[block.record] if block.record < len(found.records) else block.record + 1
    sentence = (
        f"row {number + 1} of record '{name}' ({number * found.sampling_time:g} s) carries "
        f"{percent(share)} of the squared error, at output {found.outputs[output]}: measured "
        f"{block.y[row, output]:.4g}, simulated {block.y_hat[row, output]:.4g}"
    )
    many = sum(e.size for e in errors) >= 100
    if not many or share < _ALONE:
        return Check("largest error", Verdict.SHOWN, sentence)
    return Check(
        "largest error", Verdict.DOUBT, f"{sentence}; look at this sample first", None, share
    )
