"""A metric for those who care about the worst moments."""

from __future__ import annotations

import numpy as np

from asia.data import Array
from asia.problem.metrics import Metric


def percentile_95(y: Array, y_hat: Array) -> Array:
    """95th percentile of the absolute error of each channel, (ny,)."""
    return np.percentile(np.abs(y - y_hat), 95.0, axis=0)


P95 = Metric("p95", "95 % error", percentile_95, loss="mse")
