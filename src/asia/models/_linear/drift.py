"""Input offset at which a system with free integrators is at rest."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from asia.data import Array
from asia.models._data.records import ScaledData
from asia.models._linear.fit import Refinement, fit

_ITERATIONS = 20


def drift_shift(records: ScaledData, order: int, integrators: int) -> Array:
    """Offset (nu,) to add to the inputs so that the integrators are at rest at zero.

    It is found by a fit with a constant as a further input; of several offsets it is the smallest.
    """
    known = [
        replace(r, u=np.hstack([r.u, np.ones((len(r), 1))]), measured_u=r.measured_u)
        for r in records
    ]
    refinement = Refinement(iterations=_ITERATIONS, integrators=integrators)
    s = fit(known, max(order, integrators + 1), refinement).system
    m = s.order - integrators
    steady = np.linalg.solve(np.eye(m) - s.a[:m, :m], s.b[:m])
    rates = s.a[m:, :m] @ steady + s.b[m:]
    # Only the first state of a chain drifts; the others integrate it.
    return np.asarray(np.linalg.lstsq(rates[:, :-1], rates[:, -1], rcond=1e-3)[0], np.float64)
