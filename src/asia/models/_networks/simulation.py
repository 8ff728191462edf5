"""Simulation of a network with given parameters: in NumPy, or in JAX where that is worth it.

JAX compiles anew for each length and each number of windows. Measured in fresh processes of one
thread, in seconds of processor time; those of JAX include its import (0.35) and compilation:

| network | windows x samples | NumPy | JAX |
|---|---|---|---|
| GRU, 32 units | 1 x 1 000 | 0.01 | 0.8 |
| LSTM, 2 x 256 units | 1 x 3 000 | 0.5 | 1.2 |
| LSTM, 64 units | 4 000 x 50 | 0.2 | 1.1 |
| LSTM, 256 units | 4 000 x 50 | 1.6 | 2.4 |
| convolutions, 16 channels | 4 000 x 50 | 0.4 | 1.5 |
| Transformer, 32 channels | 256 x 50 | 0.2 | 1.2 |
| Transformer, 32 channels | 4 000 x 50 | 3.1 | 2.9 |
| GRU, 32 units | 1 x 100 000 | 1.3 | 0.8 |
| cascaded LTC, 2 x 16 states | 1 x 100 000 | 2.8 | 1.0 |

Width and windows are no reason for JAX, steps in time are: each costs NumPy 10 to 30 us. One
simulation is worth its compilation from about 70 000 steps on; the switch lies higher, because
checks ask a model for many lengths. It depends only on shapes, so that a request has the same
answer in every process.
"""

from __future__ import annotations

import numpy as np

from asia.models._arrays import AnyArray
from asia.models._networks.structure import (
    Cell,
    FeatureMap,
    NetworkStructure,
    Params,
    SequenceMap,
    Simulate,
    rollout,
    trace,
)

_MOST_STEPS = 200_000
# Windows of a cell, and samples of a structure that computes all of them at once, in NumPy at a
# time: few enough for their arrays to stay in the processor's cache.
_ROWS, _SAMPLES = 256, 2048


def outputs_of(cell: NetworkStructure, params: Params, window: AnyArray, u: AnyArray) -> AnyArray:
    """Outputs (B, T, ny) of a network, all z-scored NumPy arrays of one precision: window (B, d)
    and u (B, T, nu)."""
    return _simulated(rollout, cell, params, window, u)


def features_of(cell: Cell | FeatureMap, params: Params, window: AnyArray, u: AnyArray) -> AnyArray:
    """Features (B, T, hidden) that the outputs are read from."""
    return _simulated(trace, cell, params, window, u)


def is_compiled(windows: int, samples: int) -> bool:
    """Return whether a simulation of so many windows of so many samples is left to JAX."""
    return -(-windows // _ROWS) * samples > _MOST_STEPS


def _simulated(
    simulate: Simulate, cell: NetworkStructure, params: Params, window: AnyArray, u: AnyArray
) -> AnyArray:
    count, samples = u.shape[:2]
    if is_compiled(count, samples):
        from asia.models._networks.compiled import compiled

        return compiled(simulate, cell, params, window, u)
    rows = _ROWS
    if isinstance(cell, FeatureMap | SequenceMap):
        rows = max(1, _SAMPLES // max(samples, 1))
    starts = range(0, max(count, 1), rows)
    with np.errstate(all="ignore"):
        parts = [simulate(cell, params, window[i : i + rows], u[i : i + rows]) for i in starts]
    return parts[0] if len(parts) == 1 else np.concatenate(parts)
