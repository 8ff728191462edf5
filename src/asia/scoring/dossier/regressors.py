"""Regressors of residuals, one group for each kind of missing dynamics.

Each group of columns is for one block. All columns of a block have the same rows: the samples from
`reach` on, so that each has its past.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from asia.data import Array
from asia.scoring.dossier.records import SimulatedBlock, SimulatedBlocks

# First and last lag of the moving averages that represent the past of a signal.
_LAGS = ((0, 0), (1, 1), (2, 2), (3, 3), (4, 5), (6, 8), (9, 12), (13, 18), (19, 27), (28, 40))
# The effect of a switching force lasts as long as the memory of the system.
_LONG_LAGS = (*_LAGS, (41, 60), (61, 80))
_FEW_LAGS = ((0, 0), (1, 1), (2, 3), (4, 7), (8, 15))
_MOST_INPUTS_BENT = 4
# Beyond these quantiles of a signal a bend may begin.
_BENDS = (0.15, 0.3, 0.7, 0.85)
_STILL = 0.05


@dataclass(frozen=True)
class Groups:
    """The columns for one output, one array (n, columns) a block."""

    reach: int
    """Samples that are left out at the start of each block."""
    inputs: list[Array]
    """The past of all inputs."""
    simulated: list[Array]
    """The past of the simulated output."""
    bends: list[Array]
    """Bends of the simulated output and of the inputs."""
    turns: list[Array]
    """Signs of the simulated output and of its rate, and their past."""
    recent_turns: list[Array]
    """The same, with a short past."""
    time: list[Array]
    """Slow functions of the time in the record."""


def groups(found: SimulatedBlocks, output: int) -> Groups:
    """The columns for the residual of one output."""
    blocks = found.blocks
    most = max(2, found.shortest // 6)
    lags = [pair for pair in _LAGS if pair[1] <= most]
    few = [pair for pair in _FEW_LAGS if pair[1] <= most]
    long = [pair for pair in _LONG_LAGS if pair[1] <= most]
    reach = long[-1][1]
    y_hat = [b.y_hat[:, output : output + 1] for b in blocks]
    rate = [np.gradient(v, axis=0) for v in y_hat]
    bent = [_bends(y_hat)]
    if len(found.inputs) <= _MOST_INPUTS_BENT:
        for number in range(len(found.inputs)):
            each = _bends([b.u[:, number : number + 1] for b in blocks])
            bent.append([_past(v, few) for v in each])
    signs = [_signs(y_hat), _signs(rate)]
    return Groups(
        reach,
        [_past(b.u, lags)[reach:] for b in blocks],
        [_past(v, few)[reach:] for v in y_hat],
        [np.concatenate(parts, axis=1)[reach:] for parts in zip(*bent, strict=True)],
        _pasts(signs, long, reach),
        _pasts(signs, few, reach),
        [_time(b)[reach:] / _longest(blocks) for b in blocks],
    )


def _pasts(
    signals: Sequence[Sequence[Array]], lags: Sequence[tuple[int, int]], reach: int
) -> list[Array]:
    """The past of several signals, one array a block.

    Args:
        signals: (n, c) a signal and block
    """
    together = zip(*signals, strict=True)
    return [np.concatenate([_past(v, lags) for v in each], axis=1)[reach:] for each in together]


def _past(x: Array, lags: Sequence[tuple[int, int]]) -> Array:
    """Average each column of (n, c) over the lags, (n, c * lags); the first value fills the time
    before it."""
    far = lags[-1][1]
    whole = np.concatenate([np.repeat(x[:1], far, axis=0), x])
    total = np.concatenate([np.zeros((1, x.shape[1])), np.cumsum(whole, axis=0)])
    ends = np.arange(len(x)) + far + 1
    means = [(total[ends - a] - total[ends - b - 1]) / (b - a + 1) for a, b in lags]
    return np.concatenate(means, axis=1)


def _bends(signal: Sequence[Array]) -> list[Array]:
    """Return the excess of one signal, (n, 1) a block, over its quantiles."""
    edges = np.quantile(np.concatenate(list(signal)), _BENDS)
    low, high = edges[: len(edges) // 2], edges[len(edges) // 2 :]
    return [np.concatenate([np.minimum(v - low, 0), np.maximum(v - high, 0)], 1) for v in signal]


def _signs(signal: Sequence[Array]) -> list[Array]:
    """The sign of one signal, softened where it is small."""
    size = float(np.concatenate(list(signal)).std()) or 1.0
    return [np.tanh(v / (_STILL * size)) for v in signal]


def _longest(blocks: Sequence[SimulatedBlock]) -> int:
    return max(b.start + len(b.y) for b in blocks)


def _time(block: SimulatedBlock) -> Array:
    """(n, 1), in samples from the start of the record."""
    return (block.start + np.arange(len(block.y), dtype=np.float64))[:, None]
