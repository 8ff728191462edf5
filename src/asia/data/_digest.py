"""sha256 of records."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence

from asia.data._trajectory import Trajectory


def data_digest(trajectories: Sequence[Trajectory]) -> str:
    """Hex sha256 over sampling times, shapes and values, in order; names do not count.
    An output that was not measured counts as NaN."""
    digest = hashlib.sha256()
    for t in trajectories:
        digest.update(json.dumps([t.sampling_time, t.u.shape, t.y.shape]).encode())
        digest.update(t.u.astype("<f8").tobytes())
        digest.update(t.measured_y.astype("<f8").tobytes())
    return digest.hexdigest()
