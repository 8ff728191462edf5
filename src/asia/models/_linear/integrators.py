"""Linear systems whose last states integrate: their poles are held at 1.

A = [[A1, 0], [F, L]] with L lower triangular and ones on its diagonal, so that each of the last
states integrates those before it. A start is found from differences of the outputs.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from asia.data import Array
from asia.models._data.records import ScaledData
from asia.models._linear.subspace import spread_poles, starts


def free_entries(order: int, integrators: int) -> Array:
    """Mask of A (order, order): 1 where an entry is searched, 0 where it is held."""
    free, m = np.ones((order, order)), order - integrators
    free[:m, m:] = 0.0
    free[m:, m:] = np.tril(np.ones((integrators, integrators)), -1)
    return free


def held_entries(order: int, integrators: int) -> Array:
    """Values of the held entries of A (order, order), zero elsewhere."""
    return np.diag(np.r_[np.zeros(order - integrators), np.ones(integrators)])


def integrating_starts(
    records: ScaledData, order: int, integrators: int
) -> list[tuple[Array, Array] | None]:
    """Pairs (A, C) of the order, from differences of the outputs that change least from sample to
    sample.

    Raises:
        ValueError: if the order is less than the number of integrators.
    """
    if order < integrators:
        raise ValueError(f"{integrators} integrators need an order of at least {integrators}")
    times = _integrations(records, integrators)
    ny, m = len(times), order - integrators
    if m == 0:
        return [_extended(np.zeros((0, 0)), np.zeros((ny, 0)), times)]
    differences = [np.array(r.y) for r in records]
    for output, count in enumerate(times):
        for y in differences:
            for _ in range(count):
                y[:-1, output] = np.diff(y[:, output])
                y[-1, output] = y[-2, output]
    size = np.concatenate(differences).std(axis=0)
    size = np.where(size > 0, size, 1.0)
    steps = [replace(r, y=y / size) for r, y in zip(records, differences, strict=True)]
    pairs = [s.start(m) for s in starts(steps, max(m, 4))]
    found = [_extended(a, c * size[:, None], times) for a, c in (p for p in pairs if p is not None)]
    return [*found, _extended(*spread_poles(m, ny), times)]


def _integrations(records: ScaledData, integrators: int) -> list[int]:
    """Number of integrations of each output: the slowest first, and again from the slowest."""
    y = [r.y for r in records]
    steps = np.concatenate([np.diff(v, axis=0) for v in y]).std(axis=0)
    slowest = np.argsort(steps / np.maximum(np.concatenate(y).std(axis=0), 1e-12), kind="stable")
    times = [0] * len(slowest)
    for k in range(integrators):
        times[int(slowest[k % len(slowest)])] += 1
    return times


def _extended(a: Array, c: Array, times: list[int]) -> tuple[Array, Array]:
    """Append integrators to the outputs of a system (a, c) for differences."""
    m, k, ny = len(a), sum(times), len(c)
    whole, seen, place = np.zeros((m + k, m + k)), np.zeros((ny, m + k)), m
    whole[:m, :m] = a
    for output, count in enumerate(times):
        if count == 0:
            seen[output, :m] = c[output]
            continue
        for number in range(count):
            whole[place, place] = 1.0
            if number == 0:
                whole[place, :m] = c[output]
            else:
                whole[place, place - 1] = 1.0
            place += 1
        seen[output, place - 1] = 1.0
    return whole, seen
