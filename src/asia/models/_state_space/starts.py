"""Starting points of neural state-space models, which simulate as the linear model does."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from asia.data import Array
from asia.models._data.encoder import Encoder, affine
from asia.models._data.records import ScaledData
from asia.models._data.scaling import Scaling
from asia.models._linear.fit import LinearFit, Refinement, refine
from asia.models._linear.system import LinearSystem
from asia.models._state_space.structure import StateSpaceStructure

# Stiffness of the elements of a start, by turns, for motions of unit size, and width of a play.
_STIFFNESS = (30.0, 2.0, 0.5)
_WIDTH = 0.5
# Samples for the size of the signals that elements act on.
_SIZED = 4000


def symmetric(
    found: LinearFit, records: ScaledData, copies: int, refinement: Refinement
) -> LinearFit:
    """Refine the linear model on records and their transformations, so that it is symmetric;
    transformed records start at rest."""
    x0 = np.zeros((len(records), found.system.order))
    x0[::copies] = found.x0
    return refine(records, replace(found, x0=x0), refinement)


def with_elements(structure: StateSpaceStructure, found: LinearFit) -> LinearFit:
    """Add elements at rest to the initial states of the linear model."""
    more = structure.size - structure.order
    return replace(found, x0=np.pad(found.x0, ((0, 0), (0, more))))


def encoded_at_rest(structure: StateSpaceStructure, encoder: Encoder) -> Encoder:
    """Affine encoder of the linear model's state, with elements at rest."""
    more = structure.size - structure.order
    return affine(np.pad(encoder.weights, ((0, 0), (0, more))), np.pad(encoder.bias, (0, more)))


def starts_of(
    structure: StateSpaceStructure,
    found: LinearFit,
    records: ScaledData,
    count: int,
    scaling: Scaling,
    rng: np.random.Generator,
) -> list[dict[str, Any]]:
    """Make so many starting points."""
    s = found.system
    starts = [structure.start(s, rng) for _ in range(count)]
    if structure.size == structure.order:
        return starts
    u, zero = records[0].u[:_SIZED], -scaling.y_mean / scaling.y_std
    states = s.simulate(found.x0[:1, : s.order], u[None])[0][0]
    for number, start in enumerate(starts):
        if structure.friction:
            some = number * structure.friction
            start["dry"] = _friction(s, states, zero, range(some, some + structure.friction), rng)
        if structure.play:
            some = number * structure.play
            start["play"] = _play(s, states, u, range(some, some + structure.play), rng)
    return starts


def _friction(
    system: LinearSystem, states: Array, zero: Array, turns: range, rng: np.random.Generator
) -> dict[str, Any]:
    """Elements of friction without effect, one for each number in `turns`.

    The directions are the difference of the output, the output, and random ones, in turn.

    Args:
        system: linear system.
        states: states (T, n) of the linear system, which give the sizes.
        zero: outputs at rest (ny,).
        turns: numbers of the elements.
        rng: random generator.
    """
    n, ny, count = system.order, len(system.c), len(turns)
    difference = system.c @ (np.eye(n) - np.linalg.pinv(system.a))
    known = [*((row, 0.0) for row in difference), *zip(system.c, system.offset - zero, strict=True)]
    rows: list[tuple[Array, float]] = []
    for turn in turns:
        cycle = turn % (len(known) + 1)
        rows.append(known[cycle] if cycle < len(known) else (rng.standard_normal(n), 0.0))
    w, bias = np.stack([row for row, _ in rows], axis=1), np.array([b for _, b in rows])
    sizes = _sizes(states @ w)
    stiffness = [_STIFFNESS[k % len(_STIFFNESS)] for k in range(turns.start // count, turns.stop)]
    return {
        "w": w / sizes,
        "b": bias / sizes,
        "g": np.zeros((count, n)),
        "h": np.zeros((count, ny)),
        "stiff": np.log(stiffness[:count]),
        "uneven": np.zeros(count),
        "extra": np.zeros(count),
        "narrow": np.full(count, np.log(5.0)),
    }


def _play(
    system: LinearSystem, states: Array, u: Array, turns: range, rng: np.random.Generator
) -> dict[str, Any]:
    """Elements of play without effect, one for each number in `turns`.

    The directions are the inputs, the outputs, and random ones, in turn, and each round of them has
    half the width of the one before.

    Args:
        system: linear system.
        states: states (T, n) of the linear system.
        u: inputs (T, nu).
        turns: numbers of the elements.
        rng: random generator.
    """
    n, nu, count = system.order, u.shape[1], len(turns)
    known = [np.eye(n + nu)[n + j] for j in range(nu)]
    known += [np.concatenate([row, np.zeros(nu)]) for row in system.c]
    rows: list[Array] = []
    for turn in turns:
        cycle = turn % (len(known) + 1)
        rows.append(known[cycle] if cycle < len(known) else rng.standard_normal(n + nu))
    both = np.stack(rows, axis=1)
    width = _WIDTH * 0.5 ** (turns.start // (len(known) + 1) % 3)
    both = both / (_sizes(np.hstack([states, u]) @ both) * width)
    return {
        "w": both[:n],
        "wu": both[n:],
        "g": np.zeros((count, n)),
        "h": np.zeros((count, len(system.c))),
    }


def _sizes(values: Array) -> Array:
    """Standard deviation of each column."""
    found = values.std(axis=0)
    return np.where(found > 1e-9, found, 1.0)
