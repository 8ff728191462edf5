"""Reconstruction of outputs that were not measured, from a model of the records."""

from dataclasses import replace

import numpy as np

from asia.candidate import Context
from asia.data.trajectory import Array
from asia.models._numerics.segments import ScaledSimulator
from asia.models._numerics.training_records import ScaledData, ScaledTrajectory, past_length

# Greatest assumed correlation of simulation errors in time.
_MOST = 0.98


def reconstructed(
    records: ScaledData, simulate: ScaledSimulator, context: Context
) -> list[ScaledTrajectory]:
    """Fill the gaps of scaled records with simulated outputs and the expected error of the
    simulation.

    The error is modelled as a first-order autoregression between the measured neighbours. Samples
    of the past window stay unchanged.
    """
    past = past_length(context)
    each, errors = list[Array](), list[Array]()
    for r in records:
        before_u = r.undelayed_u[None, past - context.n_past_u : past]
        before_y = r.y[None, past - context.n_past_y : past]
        each.append(simulate(before_u, before_y, r.u[None, past:])[0])
        errors.append(np.where(r.counts[past:] > 0, r.y[past:] - each[-1], np.nan))
    # Correlation (ny,) of neighbours that were both measured.
    ny = errors[0].shape[1]
    cross, square = np.zeros(ny), np.full(ny, 1e-300)
    for e in errors:
        both = ~np.isnan(e[1:]) & ~np.isnan(e[:-1])
        a, b = np.where(both, e[1:], 0.0), np.where(both, e[:-1], 0.0)
        cross += (a * b).sum(axis=0)
        square += 0.5 * (a**2 + b**2).sum(axis=0)
    rho = np.clip(cross / square, 0.0, _MOST)
    found: list[ScaledTrajectory] = []
    for r, y, e in zip(records, each, errors, strict=True):
        filled = r.y.copy()
        columns = [_bridged(one, float(c)) for one, c in zip(e.T, rho, strict=True)]
        guess = y + np.stack(columns, axis=1)
        filled[past:] = np.where(r.counts[past:] > 0, r.y[past:], guess)
        found.append(replace(r, y=filled, filled=True))
    return found


def _bridged(error: Array, rho: float) -> Array:
    """Replace NaN in error (T,) by the expectation of an autoregression between its measured
    neighbours."""
    if rho <= 0.0 or not np.isfinite(error).any():
        return np.nan_to_num(error)
    time, known = np.arange(len(error)), np.flatnonzero(np.isfinite(error))
    place = np.searchsorted(known, time)
    left = known[np.maximum(place - 1, 0)]
    right = known[np.minimum(place, len(known) - 1)]
    before = np.where(place > 0, time - left, np.inf)
    after = np.where(place < len(known), right - time, np.inf)
    # Conditional mean of a first-order autoregression with unit variance.
    a, b = rho**before, rho**after
    share = 1.0 - (a * b) ** 2
    share = np.where(share > 0.0, share, 1.0)
    bridge = (a * (1.0 - b**2) * error[left] + b * (1.0 - a**2) * error[right]) / share
    return np.where(np.isfinite(error), np.nan_to_num(error), bridge)
