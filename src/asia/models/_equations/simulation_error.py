"""The sum of squares that training makes small, and its normal equations."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from asia.data import Array
from asia.models._data.cuts import Indices
from asia.models._equations.config import GreyBoxStructure
from asia.models._equations.starts import RecordPieces, Starts
from asia.models._solvers.minimise import NormalEquations

if TYPE_CHECKING:
    from asia.models._equations.programs import CompiledSimulator

_INITIAL_RIDGE = 1e-6
# Physical quantities are held only as far as the data say nothing of them.
_WEAK = 1e-3


class SimulationError:
    """Normalised, masked and, where asked for, robust errors of the fits from `starts`, with the
    ridges. One row a start; theta (n,) holds coordinates, and shifts (S, nx) of the initial states
    in units of their scale unless these are measured.
    """

    def __init__(
        self,
        structure: GreyBoxStructure,
        segments: RecordPieces,
        starts: Starts,
        active: Array,
        runs: tuple[CompiledSimulator, CompiledSimulator],
    ) -> None:
        """active (size,): 1 where a coordinate is fitted. runs: for the costs of several points a
        start, and for the derivatives at one."""
        self._structure, self._segments, self._starts = structure, segments, starts
        self._active, (self._many, self._one) = active, runs
        mask = segments.mask / np.sqrt(segments.mask.sum() * structure.ny)
        self._weight = mask[..., None] / starts.scales.y_scale[:, 0]

    @property
    def theta0(self) -> Array:
        """Where the fits start (R, n)."""
        if self._structure.measured:
            return self._starts.z
        return np.concatenate([self._starts.z, self._starts.shift.reshape(len(self), -1)], axis=1)

    def __len__(self) -> int:
        return len(self._starts.z)

    def cost(self, theta: Array) -> Array:
        """(R, K) at points (R, K, n)."""
        count = theta.shape[1]
        repeated = np.repeat(np.arange(len(self)), count)
        z, shift = self._parts(theta.reshape(-1, theta.shape[2]))
        x0 = self._initial(repeated, shift)
        with np.errstate(all="ignore"):
            y, _ = self._many(z, self._starts.scales.of_rows(repeated), x0)
            e, _ = self._errors(slice(None), y)
            total = np.einsum("rstn,rstn->r", e, e)
            total = total + (self._prior(z)[0] ** 2).sum(axis=1)
            if not self._structure.measured:
                total = total + _INITIAL_RIDGE / shift.shape[1] * (shift**2).sum(axis=(1, 2))
        return total.reshape(-1, count)

    def linearise(self, theta: Array) -> NormalEquations:
        """At theta (R, n). A segment's errors depend on its own initial state only."""
        size, nx, count = self._structure.layout.size, self._structure.nx, theta.shape[1]
        z, shift = self._parts(theta)
        cost = np.zeros(len(self))
        gram = np.zeros((len(self), count, count))
        gradient = np.zeros((len(self), count))
        x0 = self._initial(np.arange(len(self)), shift)
        with np.errstate(all="ignore"):
            for part, y, dy in self._one.derivatives(z, self._starts.scales, x0):
                e, slope = self._errors(part, y)
                jacobian = (slope[..., None] * dy).reshape(*y.shape[:2], -1, dy.shape[-1])
                jacobian[..., :size] *= self._active
                if not self._structure.measured:
                    jacobian[..., size:] *= self._starts.scales.x_scale.T[:, None, None]
                turned = jacobian.swapaxes(2, 3)
                cost += np.einsum("rstn,rstn->r", e, e)
                own, pull = turned @ jacobian, (turned @ e.reshape(*y.shape[:2], -1, 1))[..., 0]
                gram[:, :size, :size] += own[..., :size, :size].sum(axis=1)
                gradient[:, :size] += pull[..., :size].sum(axis=1)
                if self._structure.measured:
                    continue
                for k, s in enumerate(range(part.start, part.stop)):
                    here = slice(size + s * nx, size + (s + 1) * nx)
                    gram[:, here, here] = own[:, k, size:, size:]
                    gram[:, :size, here] = own[:, k, :size, size:]
                    gram[:, here, :size] = own[:, k, size:, :size]
                    gradient[:, here] = pull[:, k, size:]
            self._add_ridges(z, theta[:, size:], cost, gram, gradient)
        return NormalEquations(cost, gram, gradient)

    def _add_ridges(
        self, z: Array, shift: Array, cost: Array, gram: Array, gradient: Array
    ) -> None:
        """shift (R, S nx)."""
        size, diagonal = z.shape[1], np.arange(gram.shape[1])
        prior, slope = self._prior(z)
        cost += (prior**2).sum(axis=1)
        gram[:, diagonal[:size], diagonal[:size]] += slope**2
        gradient[:, :size] += slope * prior
        if shift.shape[1]:
            ridge = _INITIAL_RIDGE / (shift.shape[1] // self._structure.nx)
            cost += ridge * (shift**2).sum(axis=1)
            gram[:, diagonal[size:], diagonal[size:]] += ridge
            gradient[:, size:] += ridge * shift

    def _parts(self, theta: Array) -> tuple[Array, Array]:
        """Coordinates (K, size) and shifts (K, S, nx)."""
        size, nx = self._structure.layout.size, self._structure.nx
        if self._structure.measured:
            return theta, np.zeros((len(theta), len(self._segments.u), nx))
        return theta[:, :size], theta[:, size:].reshape(len(theta), -1, nx)

    def _initial(self, chosen: Indices, shift: Array) -> Array:
        return self._starts.x_guess[chosen] + shift * self._starts.scales.x_scale.T[chosen][:, None]

    def _errors(self, part: slice, y: Array) -> tuple[Array, Array]:
        """Errors of outputs (K, S, T, ny) of some segments, and their derivatives by these."""
        weight = self._weight[part]
        scale = self._starts.scales.y_scale[:, 0]
        error = (y - self._segments.y[part]) / scale
        threshold = self._structure.config.robust
        if threshold is None:
            return error * (weight * scale), weight
        tail = np.sqrt(np.maximum(2.0 * threshold * np.abs(error) - threshold**2, 1e-12))
        near = np.abs(error) <= threshold
        slope = np.where(near, 1.0, threshold / tail)
        return np.where(near, error, np.sign(error) * tail) * (weight * scale), slope * weight

    def _prior(self, z: Array) -> tuple[Array, Array]:
        """Square roots (K, size) of the penalties on coordinates z, and their derivatives."""
        layout, config = self._structure.layout, self._structure.config
        weights = np.full(layout.size, np.sqrt(config.ridge))
        for part in (layout.parameters, layout.limits, layout.spill):
            weights[part] = _WEAK
        weights[layout.hidden] = weights[layout.readout] = np.sqrt(config.residual_ridge)
        weights = weights * self._active
        effect, slope = z.copy(), np.ones_like(z)
        effect[:, layout.spill] = slope[:, layout.spill] = np.exp(z[:, layout.spill])
        return weights * effect, weights * slope
