"""Sum of squares that training minimises, and its normal equations."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from asia.data.trajectory import Array
from asia.models._equations.config import GreyBoxStructure
from asia.models._equations.simulate import physical_parameters
from asia.models._equations.starts import RecordSegments, Starts
from asia.models._least_squares import NormalEquations
from asia.models._noise.model import ErrorWeighting, huber_root
from asia.models._numerics.training_records import Indices

if TYPE_CHECKING:
    from asia.models._equations.programs import CompiledSimulator

_INITIAL_RIDGE = 1e-6
# Steps of the differences, in coordinates whose search ranges are about 1 wide: forward ones in a
# search, central ones where derivatives are reported; rounding grows below them.
_FORWARD, _CENTRAL = 1e-7, 1e-6
# Weak ridge on physical quantities, which acts only where the data carry no information.
_WEAK = 1e-3


class SimulationError:
    """Normalised, masked and, if so configured, robust errors of the fits from `starts`, with the
    ridges.

    With a noise model the errors are innovations times the deviation of the residuals, and
    the cost is the negative log posterior times 2 v / N, where N counts the values and v is the
    mean normalised variance of a residual: a penalty in deviations of a prior has the weight v / N,
    and a ridge the prior deviation that it has beside white noise of that variance.

    One row a start; theta (n,) holds coordinates, and shifts (S, nx) of the initial states
    in units of their scale unless these are measured.
    """

    def __init__(
        self,
        structure: GreyBoxStructure,
        segments: RecordSegments,
        starts: Starts,
        active: Array,
        simulate: CompiledSimulator,
        whiten: ErrorWeighting | None = None,
        *,
        forward: bool = False,
    ) -> None:
        """`active` (size,) is 1 where a coordinate is fitted; `whiten` is the weighting of
        generalised least squares, in units of `y_scale`, None for least squares. `forward` takes
        forward differences for the normal equations, at half the cost."""
        self._structure, self._segments, self._starts = structure, segments, starts
        self._active, self._simulate, self._whiten = active, simulate, whiten
        self._central = not forward
        samples = segments.counts.sum()
        self._weight = segments.counts / np.sqrt(samples)
        ridge = structure.config.ridge
        self._prior_weight = np.sqrt(ridge) if whiten is None else whiten.unit / np.sqrt(samples)
        self._last: tuple[Array, NormalEquations] | None = None

    @property
    def theta0(self) -> Array:
        """Starting points of the fits (R, n)."""
        if self._structure.states_measured:
            return self._starts.z
        return np.concatenate([self._starts.z, self._starts.shift.reshape(len(self), -1)], axis=1)

    def __len__(self) -> int:
        return len(self._starts.z)

    def cost(self, theta: Array) -> Array:
        """Cost (R, K) at points (R, K, n). Rows that stay where they were linearised are not
        computed again."""
        total, moved = np.empty(theta.shape[:2]), np.arange(len(theta))
        if self._last is not None:
            before, found = self._last
            total[:] = found.cost[:, None]
            moved = moved[(theta != before[:, None]).any(axis=(1, 2))]
        if len(moved):
            total[moved] = self._cost(theta[moved], moved)
        return total

    def _cost(self, theta: Array, chosen: Indices) -> Array:
        z, shift = self._parts(theta)
        with np.errstate(all="ignore"):
            total = (self._prior(z)[0] ** 2).sum(axis=2)
            if len(self._structure.priors):
                total += (self._deviations(z) ** 2).sum(axis=0)
            if not self._structure.states_measured:
                total += _INITIAL_RIDGE / shift.shape[2] * (shift**2).sum(axis=(2, 3))
            for part in self._simulate.pieces():
                e = self._errors(chosen, z, shift, part)
                total += np.einsum("rkstn,rkstn->rk", e, e)
        return total

    def linearise(self, theta: Array) -> NormalEquations:
        """Normal equations at theta (R, n). Rows that have not moved since the last call are not
        computed again."""
        moved = np.arange(len(self))
        if self._last is None:
            found = self._normal_equations(theta, moved)
        else:
            before, found = self._last
            moved = moved[(theta != before).any(axis=1)]
            if len(moved):
                fresh = self._normal_equations(theta[moved], moved)
                for kept, new in zip(found, fresh, strict=True):
                    kept[moved] = new
        self._last = theta.copy(), found
        return found

    def _normal_equations(self, theta: Array, chosen: Indices) -> NormalEquations:
        """Normal equations of some rows, by differences. A segment's errors depend on its own
        initial state only, so those of all segments are moved together."""
        size, nx, count = self._structure.layout.size, self._structure.nx, theta.shape[1]
        fitted = np.flatnonzero(self._active)
        cost, gram, gradient = (
            np.zeros((len(theta), *shape)) for shape in ((), (count, count), (count,))
        )
        central = self._central
        z, shift = self._parts(self._around(theta, fitted, central=central))
        with np.errstate(all="ignore"):
            for part in self._simulate.pieces():
                e, jacobian = self._derivatives(chosen, z, shift, part, central=central)
                transposed = jacobian.swapaxes(2, 3)
                own, pull = transposed @ jacobian, (transposed @ e[..., None])[..., 0]
                cost += np.einsum("rsm,rsm->r", e, e)
                shared = slice(len(fitted))
                gram[:, fitted[:, None], fitted] += own[..., shared, shared].sum(axis=1)
                gradient[:, fitted] += pull[..., shared].sum(axis=1)
                if self._structure.states_measured:
                    continue
                for k, s in enumerate(range(part.start, part.stop)):
                    here = np.arange(size + s * nx, size + (s + 1) * nx)
                    both = np.concatenate([fitted, here])
                    gram[:, here[:, None], both] = own[:, k, len(fitted) :]
                    gram[:, fitted[:, None], here] = own[:, k, shared, len(fitted) :]
                    gradient[:, here] = pull[:, k, len(fitted) :]
            self._add_ridges(theta, cost, gram, gradient)
            self._add_knowledge(z, fitted, cost, gram, gradient)
        return NormalEquations(cost, gram, gradient)

    def jacobians(self, theta: Array) -> tuple[Array, Array, Array]:
        """Errors (S, T, ny) of the first row of theta (1, n), weighted as in the cost, their
        derivatives (S, T, ny, P) by the coordinates that are fitted, and (S, T, ny, nx) by the
        segment's own initial state, () where that is measured."""
        fitted, first = np.flatnonzero(self._active), np.arange(1)
        z, shift = self._parts(self._around(theta[:1], fitted, central=True))
        with np.errstate(all="ignore"):
            found = [
                self._derivatives(first, z, shift, p, central=True) for p in self._simulate.pieces()
            ]
        e, jacobian = (np.concatenate([part[i][0] for part in found]) for i in range(2))
        e = e.reshape(self._segments.y.shape)
        jacobian = jacobian.reshape(*e.shape, -1)
        return e, jacobian[..., : len(fitted)], jacobian[..., len(fitted) :]

    def penalties(self, theta: Array) -> tuple[Array, Array, float]:
        """Contributions (P, P) of ridges, and of priors, to the normal equations of the coordinates
        that are fitted, at theta (1, n); and the weight of the priors.

        The weak ridge on physical quantities is left out: it helps the search and is no knowledge.
        """
        layout, fitted = self._structure.layout, np.flatnonzero(self._active)
        cost, gradient = np.zeros(1), np.zeros((1, theta.shape[1]))
        held, known = np.zeros((2, 1, theta.shape[1], theta.shape[1]))
        self._add_ridges(theta[:1], cost, held, gradient)
        z, _ = self._parts(self._around(theta[:1], fitted, central=self._central))
        self._add_knowledge(z, fitted, cost, known, gradient)
        known[:, layout.learned, layout.learned] += held[:, layout.learned, layout.learned]
        for part in (layout.parameters, layout.limits, layout.spill, layout.learned):
            held[:, part, part] = 0.0
        chosen = np.ix_(fitted, fitted)
        return held[0][chosen], known[0][chosen], float(self._prior_weight**2)

    def _derivatives(
        self, chosen: Indices, z: Array, shift: Array, part: slice, *, central: bool
    ) -> tuple[Array, Array]:
        """Errors (R, S, M) of M values a segment, and their derivatives (R, S, M, K), at points as
        from `_around`."""
        found = self._errors(chosen, z, shift, part)
        found = found.reshape(*found.shape[:3], -1)
        return found[:, 0], _slopes(found.transpose(0, 2, 3, 1), central=central)

    def _around(self, theta: Array, fitted: Indices, *, central: bool) -> Array:
        """Points theta (R, n), then every unknown moved up, and if central then down: (R, K, n)."""
        size, nx = self._structure.layout.size, self._structure.nx
        moves = np.eye(size + nx)[fitted]
        if not self._structure.states_measured:
            moves = np.concatenate([moves, np.eye(nx, size + nx, size)])
        # A change of the initial state applies to every segment.
        every = (theta.shape[1] - size) // nx
        moves = np.concatenate([moves[:, :size], np.tile(moves[:, size:], (1, every))], axis=1)
        none = np.zeros((1, theta.shape[1]))
        if central:
            return theta[:, None] + _CENTRAL * np.concatenate([none, moves, -moves])
        return theta[:, None] + _FORWARD * np.concatenate([none, moves])

    def _add_ridges(self, theta: Array, cost: Array, gram: Array, gradient: Array) -> None:
        size, diagonal = self._structure.layout.size, np.arange(theta.shape[1])
        prior, slope = self._prior(theta[:, :size])
        cost += (prior**2).sum(axis=1)
        gram[:, diagonal[:size], diagonal[:size]] += slope**2
        gradient[:, :size] += slope * prior
        shift = theta[:, size:]
        if shift.shape[1]:
            ridge = _INITIAL_RIDGE / len(self._segments.u)
            cost += ridge * (shift**2).sum(axis=1)
            gram[:, diagonal[size:], diagonal[size:]] += ridge
            gradient[:, size:] += ridge * shift

    def _add_knowledge(
        self, z: Array, fitted: Indices, cost: Array, gram: Array, gradient: Array
    ) -> None:
        """Add the priors at z (R, K, size) as from `_around`."""
        if not len(self._structure.priors):
            return
        found = self._deviations(z)
        slopes = _slopes(found, central=self._central)[..., : len(fitted)]
        e, jacobian = found[..., 0], slopes.transpose(1, 0, 2)
        transposed = jacobian.swapaxes(1, 2)
        cost += (e**2).sum(axis=0)
        gram[:, fitted[:, None], fitted] += transposed @ jacobian
        gradient[:, fitted] += (transposed @ e.T[..., None])[..., 0]

    def _deviations(self, z: Array) -> Array:
        """Weighted deviations (n, R, K) of expressions in the parameters from their priors, at
        coordinates z (R, K, size)."""
        structure = self._structure
        own = z.reshape(-1, z.shape[2]).T[structure.layout.parameters]
        found = structure.priors.deviations(physical_parameters(structure.ranges, own))
        return self._prior_weight * found.reshape(-1, *z.shape[:2])

    def _parts(self, theta: Array) -> tuple[Array, Array]:
        """Coordinates (R, K, size) and shifts (R, K, S, nx)."""
        size, nx = self._structure.layout.size, self._structure.nx
        if self._structure.states_measured:
            return theta, np.zeros((*theta.shape[:2], len(self._segments.u), nx))
        return theta[..., :size], theta[..., size:].reshape(*theta.shape[:2], -1, nx)

    def _errors(self, chosen: Indices, z: Array, shift: Array, part: slice) -> Array:
        """Errors (R, K, S, T, ny) of some rows and segments."""
        repeated, scales = np.repeat(chosen, z.shape[1]), self._starts.scales
        x0 = self._starts.x_guess[chosen, None] + shift * scales.x_scale.T[chosen, None, None]
        points, x0 = z.reshape(len(repeated), -1), x0.reshape(len(repeated), *x0.shape[2:])
        y, _ = self._simulate.piece(points, scales.of_rows(repeated), x0, part)
        error = (y - self._segments.y[part]) / scales.y_scale[:, 0]
        threshold = self._structure.config.robust
        if self._whiten is not None:
            error = self._whiten(error, part)
        elif threshold is not None:
            error = huber_root(error, threshold)
        error *= self._weight[part]
        return error.reshape(len(chosen), -1, *error.shape[1:])

    def _prior(self, z: Array) -> tuple[Array, Array]:
        """Square roots (..., size) of the penalties on coordinates z, and their derivatives."""
        layout, config = self._structure.layout, self._structure.config
        weights = np.full(layout.size, np.sqrt(config.ridge))
        for part in (layout.parameters, layout.limits, layout.spill):
            weights[part] = _WEAK
        weights[layout.learned] = self._prior_weight
        weights[layout.hidden] = weights[layout.readout] = np.sqrt(config.residual_ridge)
        weights = weights * self._active
        effect, slope = z.copy(), np.ones_like(z)
        effect[..., layout.spill] = slope[..., layout.spill] = np.exp(z[..., layout.spill])
        return weights * effect, weights * slope


def _slopes(values: Array, *, central: bool) -> Array:
    """Derivatives (..., P) of values (..., K) at the K points of `SimulationError._around`."""
    if central:
        up, down = np.split(values[..., 1:], 2, axis=-1)
        return (up - down) / (2.0 * _CENTRAL)
    return (values[..., 1:] - values[..., :1]) / _FORWARD
