"""A fitted model one sample at a time, in the form that `asia export` can read."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Steps:
    """What `as_steps()` of a model returns: the same simulation as `simulate`, for one case.

    Both functions are traced by JAX: they compute with jax.numpy, in physical units, and choose
    nothing by the values of signals. A state is any tree (tuples, lists, dicts) of arrays whose
    shapes stay the same; NumPy constants of float64 keep their precision.
    """

    initial: Callable[[Any, Any, Any], Any]
    """initial(past_u (n_past_u, nu), past_y (n_past_y, ny), u (nu,)) -> the state at the first
    sample; u is the input of that sample, for models that continue it into the past."""
    step: Callable[[Any, Any], tuple[Any, Any]]
    """step(state, u (nu,)) -> the state at the next sample, and the output (ny,) of this one."""
