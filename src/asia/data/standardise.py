"""Standardisation of the signals of one fit by its own training records, and the way back for its
model.

Light: a sandboxed worker imports it. The wrapper is stored with the fitted model inside it: its
name here must not change.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from asia.data.trajectory import LEAST_RANGE, Array, Trajectory, spread_of

if TYPE_CHECKING:
    from asia.candidate import Context


@dataclass(frozen=True)
class Standard:
    """Offset and scale (n,) of some channels, in the units of the problem."""

    offset: Array
    scale: Array

    def apply(self, values: Any) -> Any:
        """Subtract the offset from values (..., n) and divide by the scale."""
        return (values - self.offset) / self.scale

    def undo(self, values: Any) -> Any:
        """Invert `apply` in double precision. What is no array (..., n) of real numbers is returned
        unchanged: the worker refuses it in its own words."""
        if _is_traced(values):
            return values * self.scale + self.offset
        try:
            found = np.array(values, order="C", subok=False)
        except ValueError:
            return values
        if found.dtype.kind not in "biufO" or found.shape[-1:] != self.scale.shape:
            return found
        # In single precision a small signal on a large offset would be lost.
        found = found if found.dtype.kind == "O" else found.astype(np.float64, copy=False)
        return found * self.scale + self.offset


def standardised(
    records: list[Trajectory], context: Context
) -> tuple[list[Trajectory], Context, Callable[[Any], Any]]:
    """Prepare a fit as its context asks for.

    Mean and standard deviation are those of these records alone, so they say nothing about any
    other sample. Where the context asks for neither, all comes back as it is.

    Args:
        records: training records of the fit, in the units of the problem
        context: context of the candidate

    Returns:
        Standardised records, the context, whose validation score takes a model of them, and a
        function that makes of such a model one in the units of the problem.
    """
    if not (context.detrend or context.scale):
        return records, context, lambda model: model
    u, y = (_standard([getattr(r, side) for r in records], context) for side in ("u", "measured_y"))

    def restored(model: Any) -> Any:
        if not callable(getattr(model, "simulate", None)):
            return model
        steps = all(callable(getattr(model, name, None)) for name in ("initial", "step"))
        return (StandardisedSteps if steps else Standardised)(model, u, y)

    score = context.validation_score
    if score is not None:
        context = replace(context, validation_score=lambda model: score(restored(model)))
    prepared = [
        Trajectory(u.apply(r.u), y.apply(r.y), r.sampling_time, r.name, r.missing) for r in records
    ]
    return prepared, context, restored


def _standard(parts: Sequence[Array], context: Context) -> Standard:
    values = np.concatenate(parts)
    offset, scale = np.zeros(values.shape[1]), np.ones(values.shape[1])
    if context.detrend:
        offset = np.nanmean(values, axis=0)
    if context.scale:
        moves = np.nanmax(values, axis=0) - np.nanmin(values, axis=0) > LEAST_RANGE
        scale = np.where(moves, spread_of(values), 1.0)
    return Standard(offset, scale)


@dataclass(frozen=True)
class Standardised:
    """Model in the units of the problem around one that was fitted to standardised records."""

    model: Any
    u: Standard
    y: Standard

    def simulate(self, past_u: Array, past_y: Array, u: Array) -> Array:
        """Simulate as `asia.candidate.Model`."""
        u_side, y_side = self.u, self.y
        y_hat = self.model.simulate(u_side.apply(past_u), y_side.apply(past_y), u_side.apply(u))
        return y_side.undo(y_hat)

    def parameters(self) -> Any:
        """Return the parameters of the model, {} where signals were scaled: each fold has scales of
        its own, so that the parameters of two folds are in different units."""
        offered = {} if self._scaled else getattr(self.model, "parameters", {})
        return offered() if callable(offered) else offered

    def estimates(self, trajectories: Sequence[Trajectory], context: Context) -> Any:
        """Return the estimates of the model for the standardised records of its fit. Raises
        ValueError where signals were scaled."""
        if self._scaled:
            raise ValueError("parameters of scaled signals have no units of their own")
        return self.model.estimates(trajectories, context)

    @property
    def _scaled(self) -> bool:
        return bool((self.u.scale != 1.0).any() or (self.y.scale != 1.0).any())


@dataclass(frozen=True)
class StandardisedSteps(Standardised):
    """The same around a model that simulates sample by sample."""

    def initial(self, past_u: Any, past_y: Any, u: Any) -> Any:
        """State as of `asia.candidate.StepModel`."""
        return self.model.initial(self.u.apply(past_u), self.y.apply(past_y), self.u.apply(u))

    def step(self, state: Any, u: Any) -> tuple[Any, Any]:
        """Next state and output (B, ny)."""
        after, y = self.model.step(state, self.u.apply(u))
        return after, self.y.undo(y)


def _is_traced(values: object) -> bool:
    """Return whether JAX is tracing a computation with these values."""
    jax = sys.modules.get("jax")
    return jax is not None and isinstance(values, jax.core.Tracer)
