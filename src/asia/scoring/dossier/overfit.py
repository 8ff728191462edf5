"""Check of the error on held-out against training records, and its likely cause."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.signal import lfilter

from asia.data import Array
from asia.scoring.dossier.check import Cause, Check, CheckCurve, Verdict
from asia.scoring.dossier.records import SimulatedBlock, SimulatedBlocks, listed, percent

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
    simulations: SimulatedBlocks | None = None,
    apart: Sequence[str] = (),
) -> Check:
    """Compare the error on held-out records with that on training records.

    Args:
        train, held_out: normalised error of each fold's model on its training records, and on
            its held-out ones
        simulations: simulations of the held-out records
        apart: names of the parameters that differ between the fold models by more than noise
            explains
    """
    a, b = np.array(train), np.array(held_out)
    ratio = float(b.mean() / max(float(a.mean()), 1e-300))
    least = float(np.min(b / np.maximum(a, 1e-300)))
    folds = np.arange(1, len(a) + 1, dtype=np.float64)
    curves = (CheckCurve("training", folds, a), CheckCurve("held out", folds, b))
    words = (
        f"the error is {ratio:.2f} times that of the fit ({b.mean():.3g} against {a.mean():.3g})"
    )
    axes = ("fold", "normalised error [-]")
    if ratio < _DOUBT or least < _EVERY:
        return Check("held-out error", Verdict.PASS, f"on held-out samples {words}",
                     curves=curves, axes=axes)  # fmt: skip
    verdict = Verdict.FAIL if ratio >= _FAIL else Verdict.DOUBT
    cause, why = _cause(simulations, apart)
    return Check("held-out error", verdict, f"on held-out samples {words}: {why}", cause,
                 1.0 - 1.0 / ratio, curves, axes)  # fmt: skip


def _cause(found: SimulatedBlocks | None, apart: Sequence[str]) -> tuple[Cause | None, str]:
    """The cause of a larger held-out error, and the evidence for it."""
    if apart:
        verb = "differs" if len(apart) == 1 else "differ"
        return Cause.PARAMETERS, (
            f"{Cause.PARAMETERS}, or an effect is missing ({listed(apart)} {verb} between the "
            "folds by more than noise explains)"
        )
    share = None if found is None else _corrected(found)
    if share is None:
        return Cause.OVERFIT, str(Cause.OVERFIT)
    evidence = (
        f"a different gain and slow dynamics for each part explain {percent(share)} of the residual"
    )
    if share >= _DRIFTS:
        return Cause.PARAMETERS, f"{Cause.PARAMETERS} ({evidence})"
    if share <= _NOISE:
        return Cause.OVERFIT, (
            f"{Cause.OVERFIT}, because it has too many parameters or too few samples ({evidence})"
        )
    return None, (
        f"the system drifts, or the model has too many parameters for its records ({evidence})"
    )


def _corrected(found: SimulatedBlocks) -> float | None:
    """Return the share of the held-out residual that few regressors explain in the other half of
    the same block.

    The regressors are the simulated outputs and their first-order lags. Fitted noise is spread over
    more directions. None where the blocks are too short.
    """
    before = after = 0.0
    for block in found.blocks:
        columns = _correction(block)
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


def _correction(block: SimulatedBlock) -> Array:
    """Regressors (H, columns) of a change of parameters."""
    signals = block.y_hat - block.y_hat.mean(axis=0)
    signals = signals / np.maximum(signals.std(axis=0), 1e-300)
    lagged = list[Array]()
    for memory in _MEMORIES:
        pole = float(np.exp(-1.0 / memory))
        lagged.append(np.asarray(lfilter([1.0 - pole], [1.0, -pole], signals, axis=0)))
    return np.concatenate([np.ones((len(signals), 1)), signals, *lagged], axis=1)
