"""Starts of a linear system with static functions in feedback, inferred from the linear model.

The residual of the best linear model is explained by static functions of a few signals that act
on its states and outputs. Sources: Schoukens and Toth, On the initialization of nonlinear LFR model
identification with the best linear approximation, IFAC 2020; Floren, Noel and Swevers, Inference
and learning of nonlinear LFR state-space models, arXiv 2503.14409.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from asia.data import Array
from asia.models._data.records import ScaledData
from asia.models._linear.fit import LinearFit
from asia.models._linear.system import LinearSystem
from asia.models._state_space.feedback.readings import (
    RANK,
    Reading,
    ReadingSearch,
    judged_records,
    orthonormal,
    responses,
)
from asia.models._state_space.structure import StateSpaceStructure

_ALTERNATIONS = 15
# Shares of the functions that are tried.
_SCALES = (1.0, 0.5, 0.2)


def feedback_starts(
    structure: StateSpaceStructure,
    found: LinearFit,
    records: ScaledData,
    count: int,
    rng: np.random.Generator,
) -> list[dict[str, Any]]:
    """Find up to `count` starting points whose functions read different signals, the best first."""
    search = ReadingSearch(structure, found.system, judged_records(records, found), rng)
    starts = _Starts(search)
    # Signals read from the observer explain an output by itself, so starts with both kinds of
    # states are simulated and compared.
    each = [
        sorted((starts.start(r) for r in search.best(count, observed)), key=_by_error)
        for observed in (False, True)
    ]
    first = sorted((some[0] for some in each if some), key=_by_error)
    later = sorted((one for some in each for one in some[1:]), key=_by_error)
    return [params for _, params in [*first, *later][:count]]


def _by_error(start: tuple[float, dict[str, Any]]) -> float:
    return start[0]


class _Starts:
    """Starting points of one fit."""

    def __init__(self, search: ReadingSearch) -> None:
        self.search, self.structure, self.system = search, search.structure, search.system

    def start(self, regressors: Reading) -> tuple[float, dict[str, Any]]:
        """Make a starting point: the share of the functions that simulates best, with its linear
        terms.

        Returns:
            The error of its simulation, and its parameters.
        """
        layer = self.search.layer(regressors.directions, regressors.observed)
        ((gram, rhs, _),) = self.search.normal(
            [(regressors.directions, regressors.observed, layer)]
        )
        w2, act = self._factors(gram, rhs)
        found: list[tuple[float, dict[str, Any]]] = []
        for scale in _SCALES:
            moved = self._moved(regressors, layer, scale * w2 @ act)
            params = self.structure.start(moved, self.search.rng)
            params |= {"read": regressors.directions, "act": act, "f": {**layer, "w2": scale * w2}}
            found.append((self._error(params), params))
        return min(found, key=lambda one: one[0])

    def _moved(self, regressors: Reading, layer: dict[str, Array], theta: Array) -> LinearSystem:
        """Linear system that goes with functions of weights theta (h, n + ny)."""
        s, nu = self.system, self.structure.nu
        n, ny = s.order, len(s.c)
        some = (n + ny) * nu + ny
        gram, side = np.zeros((some, some)), np.zeros(some)
        for r in self.search.records:
            units = np.tanh(
                r.read(regressors.directions, regressors.observed) @ layer["w1"] + layer["b1"]
            )
            both = responses(s, units @ theta)
            # Signal i acts only on state or output i.
            explained = np.einsum("tyii->ty", both) * r.weight[:, None]
            rest, terms, start = (
                (r.residual - explained).ravel(),
                r.terms[:, :some],
                r.terms[:, some:],
            )
            start = orthonormal(start)
            terms = terms - start @ (start.T @ terms)
            gram, side = gram + terms.T @ terms, side + terms.T @ rest
        found = np.linalg.lstsq(gram, side, rcond=RANK)[0]
        change = found[: (n + ny) * nu].reshape(nu, n + ny).T
        return LinearSystem(
            s.a, s.b + change[:n], s.c, s.d + change[n:], s.offset + found[some - ny :]
        )

    def _error(self, params: dict[str, Any]) -> float:
        """Sum of squared errors of simulations from the best initial states for the linear
        system."""
        total, n = 0.0, self.structure.order
        with np.errstate(all="ignore"):
            for r in self.search.records:
                y = self.structure.simulate(params, r.x0[None], r.u[None])[1][0]
                line = self.system.simulate(r.x0[None], r.u[None])[1][0]
                rest = (r.residual - (y - line) * r.weight[:, None]).ravel()
                start = orthonormal(r.terms[:, -n:])
                rest = rest - start @ (start.T @ rest)
                total += float(rest @ rest)
        return total if np.isfinite(total) else np.inf

    def _factors(self, gram: Array, rhs: Array) -> tuple[Array, Array]:
        """Last layer (h, m) and effects of the functions (m, n + ny), by alternating least
        squares."""
        h, n_act, m = self.structure.hidden, self.structure.order + self.structure.ny, self.search.m
        theta = np.linalg.solve(gram, rhs).reshape(h, n_act)
        left, sizes, right = np.linalg.svd(theta, full_matrices=False)
        m = min(m, len(sizes))
        act, g4 = right[:m], gram.reshape(h, n_act, h, n_act)
        w2, side = left[:, :m] * sizes[:m], rhs.reshape(h, n_act)
        for _ in range(_ALTERNATIONS):
            g = np.einsum("kilj,ai,bj->kalb", g4, act, act).reshape(h * m, h * m)
            b = np.einsum("ki,ai->ka", side, act).ravel()
            w2 = np.linalg.lstsq(g, b, rcond=1e-12)[0].reshape(h, m)
            g = np.einsum("kilj,ka,lb->aibj", g4, w2, w2).reshape(m * n_act, m * n_act)
            b = np.einsum("ki,ka->ai", side, w2).ravel()
            act = np.linalg.lstsq(g, b, rcond=1e-12)[0].reshape(m, n_act)
        size = np.linalg.norm(act, axis=1)
        size = np.where(size > 1e-12, size, 1.0)
        w2, act = w2 * size, act / size[:, None]
        if m < self.search.m:
            w2 = np.pad(w2, ((0, 0), (0, self.search.m - m)))
            act = np.vstack(
                [act, self.search.rng.standard_normal((self.search.m - m, n_act)) / np.sqrt(n_act)]
            )
        return w2, act
