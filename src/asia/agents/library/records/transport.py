"""Detection of variable transport delays set by an input: a flow in a pipe, the speed of a belt."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from asia.agents._view import Facts
from asia.agents.library.records.same import SameRecords
from asia.data._transport import FoundTransport, find_transport

# Share of the squared one-step error under the best constant delay that may be left, and the least
# delay in samples: a shorter one is as good as constant.
_LARGEST_RATIO, _LEAST_DELAY = 0.6, 2.0
# Least deviation of a pace from its mean, as a share of it, and how many inputs are looked at.
_LEAST_CHANGE, _MOST_INPUTS = 0.05, 4


def transport(facts: Facts) -> FoundTransport | None:
    """The pipe that the training records show, at the pace of one of the inputs; None without."""
    return _transport(SameRecords(facts.records))


@lru_cache(maxsize=8)
def _transport(same: SameRecords) -> FoundTransport | None:
    u = np.concatenate([r.u for r in same.records])
    moving = u.std(axis=0) > _LEAST_CHANGE * np.abs(u.mean(axis=0))
    paces = [j for j in range(u.shape[1]) if u[:, j].min() > 0.0 and moving[j]]
    each = [find_transport(same.records, j) for j in paces[:_MOST_INPUTS]]
    likely = [f for f in each if f.ratio < _LARGEST_RATIO and f.delay > _LEAST_DELAY]
    return min(likely, key=lambda f: f.ratio, default=None)
