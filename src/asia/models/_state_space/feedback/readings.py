"""Search for the regressors of static functions in feedback, by the residual of the linear model.

They are searched among inputs, outputs, combinations of them and of the states. The states are
those of the linear model, and those of an observer that corrects them by the measured output, so
that a function in a loop is read at the true state of the system. For given signals the functions
and the places where they act follow by least squares, so that many regressors can be evaluated.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_discrete_are

from asia.data import Array
from asia.models._data.records import ScaledData, ScaledTrajectory
from asia.models._linear.fit import LinearFit
from asia.models._linear.system import LinearSystem
from asia.models._state_space.structure import StateSpaceStructure

# Samples for the evaluation of regressors, random signals tried, best ones varied, and the size of
# the variation in each round.
_EVALUATED, _DRAWN, _KEPT, _ROUNDS, _VARIED = 3000, 80, 4, (0.5, 0.25, 0.12), 10
# Sets of regressors evaluated together, and the greatest size of their arrays.
_BATCH, _NUMBERS = 16, 3e7
# Ridge of the functions' weights, relative to the size of their factors.
_RIDGE = 1e-4
# Assumed sensor noise of the observer, as a share of the output's variance, in addition to the
# model's error.
_SENSOR = 0.01
# Least correlation of signals that count as equal.
_ALIKE = 0.97
# Relative size below which a direction of the linear terms is rounding.
RANK = 1e-7


class Reading(NamedTuple):
    """Regressors of the functions, with the error that they leave."""

    directions: Array
    """(n + nu, m)."""
    observed: bool
    """The states are the observer's."""
    error: float
    """Mean squared error that remains."""


class JudgedRecord(NamedTuple):
    """Record prepared for the evaluation of regressors."""

    x0: Array
    """Initial state (n,) of the linear model."""
    u: Array
    """(T, nu)."""
    states: tuple[Array, Array]
    """(T, n), by the linear model and by the observer."""
    residual: Array
    """Residual (T, ny) of the linear model."""
    terms: Array
    """Effects (T ny, p) of B, D, the offset and the initial state; see `_linear_terms`."""
    basis: Array
    """Orthonormal basis (T ny, q) of `terms`."""
    weight: Array
    """(T,)."""

    def read(self, directions: Array, observed: bool) -> Array:
        """Signals (T, m) in directions (n - integrators + nu, m)."""
        some = len(directions) - self.u.shape[1]
        return self.states[observed][:, :some] @ directions[:some] + self.u @ directions[some:]


def judged_records(records: ScaledData, found: LinearFit) -> list[JudgedRecord]:
    """Prepare the first samples of each record."""
    each = max(_EVALUATED // len(records), 200)
    return [
        _record(found.system, x0, r.part(0, min(each, len(r))))
        for r, x0 in zip(records, found.x0, strict=True)
    ][: max(_EVALUATED // 200, 1)]


def _record(system: LinearSystem, x0: Array, record: ScaledTrajectory) -> JudgedRecord:
    states, outputs = (found[0] for found in system.simulate(x0[None], record.u[None]))
    residual = (record.y - outputs) * record.weight[:, None]
    observed = _observed(system, x0, record, float(np.mean(residual**2)))
    terms = _linear_terms(system, record)
    basis = orthonormal(terms)
    return JudgedRecord(x0, record.u, (states, observed), residual, terms, basis, record.weight)


def _observed(system: LinearSystem, x0: Array, record: ScaledTrajectory, error: float) -> Array:
    """States (T, n) of a Kalman filter that attributes most of the error to a disturbance of the
    states."""
    n, ny = system.order, len(system.c)
    wander = max(error, 1e-9) * (system.b @ system.b.T + 1e-3 * np.eye(n))
    noise = (_SENSOR * error + 1e-6) * np.eye(ny)
    try:
        p = solve_discrete_are(system.a.T, system.c.T, wander, noise)
    except (np.linalg.LinAlgError, ValueError):
        return system.simulate(x0[None], record.u[None])[0][0]
    gain = p @ system.c.T @ np.linalg.inv(system.c @ p @ system.c.T + noise)
    states, x = np.empty((len(record), n)), x0
    for k in range(len(record)):
        wrong = record.y[k] - system.c @ x - system.d @ record.u[k] - system.offset
        x = x + record.weight[k] * (gain @ wrong)
        states[k] = x
        x = system.a @ x + system.b @ record.u[k]
    return states


def responses(system: LinearSystem, signals: Array) -> Array:
    """Outputs (T, ny, s, n + ny) to signals (T, s) that act on each state and on each output."""
    length, s = signals.shape
    n, ny = system.order, len(system.c)
    found = np.zeros((length, ny, s, n + ny))
    state = np.zeros((s * n, n))
    each, at = np.tile(np.eye(n), (s, 1)), system.a.T
    for k in range(length):
        found[k, :, :, :n] = (system.c @ state.T).reshape(ny, s, n)
        state = state @ at + np.repeat(signals[k], n)[:, None] * each
    for i in range(ny):
        found[:, i, :, n + i] = signals
    return found


def _linear_terms(system: LinearSystem, record: ScaledTrajectory) -> Array:
    """Effects (T ny, n nu + ny nu + ny + n) of B, D, the offset and the initial state on the
    outputs."""
    length, n, ny = len(record), system.order, len(system.c)
    forced = responses(system, record.u).reshape(length * ny, -1)
    constant = np.tile(np.eye(ny), (length, 1))
    free = system.simulate(np.eye(n), np.zeros((n, length, record.u.shape[1])))[1] - system.offset
    columns = np.hstack([forced, constant, free.transpose(1, 2, 0).reshape(length * ny, n)])
    return columns * np.repeat(record.weight, ny)[:, None]


def orthonormal(columns: Array) -> Array:
    left, sizes, _ = np.linalg.svd(columns, full_matrices=False)
    return left[:, sizes > RANK * sizes[0]]


class ReadingSearch:
    """Search for the regressors of one fit."""

    def __init__(
        self,
        structure: StateSpaceStructure,
        system: LinearSystem,
        records: Sequence[JudgedRecord],
        rng: np.random.Generator,
    ) -> None:
        self.structure, self.system, self.records, self.rng = structure, system, records, rng
        self.m = structure.channels or 1
        # Number of states that may be read: a drifting state visits each level only once.
        self.free = structure.order - structure.integrators
        # Common random units of all regressors, so that only the regressors differ.
        self.drawn = rng.standard_normal((self.m, structure.hidden)), rng.random(structure.hidden)

    def best(self, count: int, observed: bool) -> list[Reading]:
        """Best regressors that differ from each other, the least error first."""
        pool = self.evaluated([(d, observed) for d in [*self._known(), *self._random()]])
        for size in _ROUNDS:
            pool.sort(key=lambda r: r.error)
            kept = self._different(pool, _KEPT)
            moved = [
                (self._varied(r.directions, size), r.observed) for r in kept for _ in range(_VARIED)
            ]
            pool = [*kept, *self.evaluated(moved)]
        pool.sort(key=lambda r: r.error)
        return self._different(pool, count)

    def _known(self) -> list[Array]:
        """Directions that systems often have: inputs, outputs, and those that change an output."""
        n, nu, s = self.structure.order, self.structure.nu, self.system
        change = np.hstack([s.c @ (s.a - np.eye(n)), s.c @ s.b])
        rows = np.vstack([np.eye(n + nu), np.hstack([s.c, s.d]), change])
        rows = np.delete(rows, range(self.free, n), axis=1)
        rows = rows[np.abs(rows).sum(axis=1) > 0]
        if self.m == 1:
            return [row[:, None] for row in rows]
        pairs = [self.rng.choice(len(rows), self.m, replace=False) for _ in range(3 * len(rows))]
        return [rows[p].T for p in pairs]

    def _random(self) -> list[Array]:
        size = (self.free + self.structure.nu, self.m)
        return [self.rng.standard_normal(size) / self._sizes()[:, None] for _ in range(_DRAWN)]

    def _sizes(self) -> Array:
        states = np.concatenate([r.states[0][:, : self.free] for r in self.records])
        spread = np.hstack(
            [states.std(axis=0), np.concatenate([r.u for r in self.records]).std(axis=0)]
        )
        return np.where(spread > 1e-9, spread, 1.0)

    def _varied(self, directions: Array, size: float) -> Array:
        sizes = self._sizes()[:, None]
        unit = directions * sizes
        unit = unit / np.linalg.norm(unit, axis=0)
        return (unit + size * self.rng.standard_normal(unit.shape)) / sizes

    def _different(self, pool: Sequence[Reading], count: int) -> list[Reading]:
        chosen: list[tuple[Reading, Array]] = []
        for regressors in pool:
            z = self._read(regressors.directions, regressors.observed)
            z = (z - z.mean(axis=0)) / z.std(axis=0)
            alike = (np.linalg.svd(z.T @ other / len(z))[1].min() > _ALIKE for _, other in chosen)
            if not any(alike):
                chosen.append((regressors, z))
            if len(chosen) == count:
                break
        return [regressors for regressors, _ in chosen]

    def evaluated(self, candidates: Sequence[tuple[Array, bool]]) -> list[Reading]:
        """Evaluate regressors; those without any variation are left out."""
        found: list[Reading] = []
        s, longest = self.structure, max(len(r.u) for r in self.records)
        each = longest * s.ny * s.hidden * (s.order + s.ny)
        batch = int(np.clip(_NUMBERS / each, 1, _BATCH))
        for first in range(0, len(candidates), batch):
            part: list[tuple[Array, bool, dict[str, Array]]] = []
            for d, o in candidates[first : first + batch]:
                scaled = self._scaled(d, o)
                if scaled is not None:
                    part.append((scaled, o, self.layer(scaled, o)))
            grams = self.normal([(d, o, layer) for d, o, layer in part]) if part else []
            for (d, o, _), (gram, rhs, power) in zip(part, grams, strict=True):
                weights = np.linalg.solve(gram, rhs)
                found.append(Reading(d, o, power - float(rhs @ weights)))
        return [r for r in found if np.isfinite(r.error)]

    def _read(self, directions: Array, observed: bool) -> Array:
        """Signals (T, m) of all records."""
        return np.concatenate([r.read(directions, observed) for r in self.records])

    def _scaled(self, directions: Array, observed: bool) -> Array | None:
        """Scale the directions so that each signal has unit size; None where that is impossible."""
        z = self._read(directions, observed)
        size = z.std(axis=0)
        return None if (size < 1e-9).any() or not np.isfinite(size).all() else directions / size

    def layer(self, directions: Array, observed: bool) -> dict[str, Array]:
        """Weights w1 (m, h) and b1 (h,) of units that cover the range of the signals."""
        z = self._read(directions, observed)
        h, (normal, uniform) = self.structure.hidden, self.drawn
        if self.m == 1:
            centres = np.quantile(z[:, 0], np.linspace(0.03, 0.97, h))[:, None]
            gaps = (centres[-1, 0] - centres[0, 0]) / max(h - 1, 1)
            w1 = np.full((1, h), 1.0 / max(gaps, 1e-3))
        else:
            centres = z[(uniform * len(z)).astype(int)]
            w1 = normal * (1.5 / np.linalg.norm(normal, axis=0))
        return {"w1": w1, "b1": -(centres * w1.T).sum(axis=1)}

    def normal(
        self, candidates: Sequence[tuple[Array, bool, dict[str, Array]]]
    ) -> list[tuple[Array, Array, float]]:
        """Normal equations of each set of regressors.

        Returns:
            Gram matrix (h (n + ny), ...) with ridge, right-hand side and the mean square of the
            residual to explain.
        """
        h, n_act = self.structure.hidden, self.structure.order + self.structure.ny
        size = h * n_act
        grams = [np.zeros((size, size)) for _ in candidates]
        sides = [np.zeros(size) for _ in candidates]
        power, samples = 0.0, 0
        for r in self.records:
            units = [
                np.tanh(r.read(d, o) @ layer["w1"] + layer["b1"]) for d, o, layer in candidates
            ]
            every = responses(self.system, np.hstack(units))
            weight = np.repeat(r.weight, self.structure.ny)[:, None]
            rest = r.residual.ravel()
            rest = rest - r.basis @ (r.basis.T @ rest)
            power, samples = power + float(rest @ rest), samples + len(rest)
            for i in range(len(candidates)):
                columns = every[:, :, i * h : (i + 1) * h].reshape(len(rest), size) * weight
                columns -= r.basis @ (r.basis.T @ columns)
                grams[i] += columns.T @ columns
                sides[i] += columns.T @ rest
        mean = [np.trace(g) / size for g in grams]
        return [
            ((g + _RIDGE * m * np.eye(size)) / samples, s / samples, power / samples)
            for g, m, s in zip(grams, mean, sides, strict=True)
        ]
