"""Sparse discovery of missing terms of the equations, by the simulation error.

All terms of a library are written into the equations with numbers that are zero. The sensitivity of
the simulation error to these numbers shows how much of the error each term would explain in
addition to the fitted parameters. The best one is freed, the model is fitted again, and so
on; terms that no longer help are removed. No derivative of a measured signal is needed, and
states may be hidden. Sources: the greedy search of Chen, Billings and Luo, Int. J. Control 50(5),
1989; the library of Brunton, Proctor and Kutz, PNAS 113(15), 2016.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from asia.data.trajectory import Array
from asia.models._equations.config import GreyBoxStructure
from asia.models._equations.extension import library, with_terms
from asia.models._equations.fit import FittedEquations, refit
from asia.models._equations.simulation_error import SimulationError
from asia.models._equations.starts import RecordSegments, Starts, opened
from asia.models._least_squares import LevenbergMarquardt, minimise

# Least relative decrease of the cost for a term to be added or kept. A smaller one is often due to
# chance, because errors of an incomplete model are correlated in time.
_LEAST_GAIN = 0.02
# Least share of a term's squared sensitivity that parameters and other terms cannot reproduce.
_LEAST_OWN = 1e-6
# Terms tried by a fit before one is added, and the iterations of such a fit.
_TRIED, _ITERATIONS = 3, 15
# Simulations of one call of the compiled program.
_ROWS = 32


def discover(
    structure: GreyBoxStructure,
    segments: RecordSegments,
    fitted: FittedEquations,
    method: LevenbergMarquardt,
) -> tuple[GreyBoxStructure, FittedEquations]:
    """Add the terms that reduce the simulation error, at most `Config.most_terms` of them, to a
    fitted grey-box.

    Returns:
        The structure with the terms, and its fit; both unchanged where no term helps.
    """
    search = _TermSearch(structure, segments, fitted, method)
    chosen = search.chosen(structure.config.most_terms)
    if not chosen:
        return structure, fitted
    found = with_terms(structure, [search.terms[k] for k in chosen])
    return found, refit(found, segments, _starts_at(fitted, len(chosen)), method)


@dataclass(frozen=True)
class _Selection:
    """Model with some of the terms."""

    chosen: tuple[int, ...]  # Numbers of its terms
    theta: Array  # Coordinates at the end of its fit (n,)
    cost: float  # Cost at `theta`


class _TermSearch:
    """Greedy search with all terms in the equations; a coordinate held at zero is no term."""

    def __init__(
        self,
        structure: GreyBoxStructure,
        segments: RecordSegments,
        fitted: FittedEquations,
        method: LevenbergMarquardt,
    ) -> None:
        from asia.models._equations.programs import CompiledSimulator

        inside, starts = segments.mask > 0, _starts_at(fitted)
        own = CompiledSimulator(structure, segments.u, 1)
        x = own(starts.z, starts.scales, starts.x_guess)[1][0]
        moves = np.diff(x, axis=1)[inside[:, 1:]] / structure.sampling_time
        rates = np.sqrt((moves**2).mean(axis=0))
        self.terms = library(structure, x[inside], segments.u[inside], rates)
        self.first = len(fitted.z)  # coordinate of the first term
        self.structure, self.segments = with_terms(structure, self.terms), segments
        self.starts = _starts_at(fitted, len(self.terms))
        self.simulate = CompiledSimulator(self.structure, segments.u, _ROWS)
        self.method = replace(method, iterations=min(method.iterations, _ITERATIONS))

    def chosen(self, most: int) -> tuple[int, ...]:
        """Numbers of the terms that help, at most so many."""
        state = self._fit((), None)
        while len(state.chosen) < most:
            trials = [self._fit((*state.chosen, k), state.theta) for k in self._promising(state)]
            best = min(trials, key=lambda s: s.cost, default=state)
            if not best.cost < (1.0 - _LEAST_GAIN) * state.cost:
                break
            state = best
            # Remove an earlier term that the newest one has made needless.
            for k in best.chosen[:-1]:
                less = self._fit(tuple(j for j in best.chosen if j != k), best.theta)
                if (1.0 - _LEAST_GAIN) * less.cost <= best.cost:
                    state = less
                    break
        return state.chosen

    def _promising(self, state: _Selection) -> list[int]:
        """First few terms in the order of the error that they would explain, by the normal
        equations at the fit with all terms free."""
        at = self._error(range(len(self.terms))).linearise(state.theta[None])
        numbers = np.arange(len(self.terms)) + self.first
        taken = numbers[list(state.chosen)]
        held = np.setdiff1d(numbers, taken)
        free = np.setdiff1d(np.arange(len(state.theta)), held)
        gram, gradient = at.gram[0], at.gradient[0]
        inner = gram[np.ix_(free, free)]
        inner = inner + 1e-10 * np.diag(np.maximum(np.diag(inner), 1e-30))
        solved = np.linalg.solve(inner, np.column_stack([gram[np.ix_(free, held)], gradient[free]]))
        whole = np.diag(gram)[held]
        own = whole - (gram[np.ix_(free, held)] * solved[:, :-1]).sum(axis=0)
        pull = gradient[held] - gram[np.ix_(free, held)].T @ solved[:, -1]
        known = own > _LEAST_OWN * whole
        gain = np.where(known, pull**2 / np.where(known, own, 1.0), 0.0)
        order = np.argsort(-gain, kind="stable")[:_TRIED]
        return [int(held[i] - self.first) for i in order if gain[i] > 0.0]

    def _fit(self, chosen: tuple[int, ...], theta: Array | None) -> _Selection:
        error = self._error(chosen)
        begin = error.theta0 if theta is None else theta[None].copy()
        idle = np.setdiff1d(np.arange(len(self.terms)), chosen) + self.first
        begin[:, idle] = 0.0
        found = minimise(error.cost, error.linearise, begin, self.method)
        return _Selection(chosen, found.theta[0], float(found.cost[0]))

    def _error(self, chosen: Sequence[int]) -> SimulationError:
        active = np.ones(self.structure.layout.size)
        active[self.first :] = 0.0
        active[[self.first + k for k in chosen]] = 1.0
        return SimulationError(self.structure, self.segments, self.starts, active, self.simulate)


def _starts_at(fitted: FittedEquations, terms: int = 0) -> Starts:
    """Single starting point: coordinates and initial states of a fit, with terms that are zero."""
    assert fitted.x0 is not None
    x0, z = fitted.x0[None], np.concatenate([fitted.z, np.zeros(terms)])
    return Starts(z[None], np.zeros_like(x0), x0, opened(fitted.scales.for_rows()))
