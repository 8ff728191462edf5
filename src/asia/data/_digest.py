"""sha256 of records."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence

import numpy as np

from asia.data._trajectory import Trajectory


def data_digest(trajectories: Sequence[Trajectory]) -> str:
    """Hex sha256 over sampling times, shapes and values, in order; names do not count.
    An output that was not measured counts as NaN."""
    digest = hashlib.sha256()
    for t in trajectories:
        digest.update(json.dumps([t.sampling_time, t.u.shape, t.y.shape]).encode())
        for values in (t.u, t.measured_y):
            digest.update(np.ascontiguousarray(values, "<f8").data)
    return digest.hexdigest()
