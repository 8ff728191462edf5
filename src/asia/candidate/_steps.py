"""A fitted model one sample at a time: simulation and `asia export` derive from this contract."""

from __future__ import annotations

from typing import Any, Protocol, runtime_checkable

import numpy as np

from asia.data import Array


@runtime_checkable
class StepModel(Protocol):
    """A fitted sequential model, in physical units, for a batch of B cases.

    Both methods compute with NumPy arrays, and with JAX arrays where they are traced (`asia
    export`): they choose nothing by the values of signals. A state is any tree (tuples, lists,
    dicts) of arrays (B, ...) whose shapes stay the same; constants of float64 keep their precision.
    A row's answer depends on this row alone.
    """

    def initial(self, past_u: Any, past_y: Any, u: Any) -> Any:
        """State at the first sample, from past_u (B, n_past_u, nu), past_y (B, n_past_y, ny) and
        the input u (B, nu) of that sample, for models that continue it into the past."""
        ...

    def step(self, state: Any, u: Any) -> tuple[Any, Any]:
        """State at the next sample, and the output (B, ny) of this one, whose input is u
        (B, nu)."""
        ...


def simulate_steps(model: StepModel, past_u: Array, past_y: Array, u: Array) -> Array:
    """Simulate step by step: past_u (B, n_past_u, nu), past_y (B, n_past_y, ny), u (B, H, nu) ->
    (B, H, ny), with H of 1 or more. The `simulate` of a model that has no faster one."""
    state, outputs = model.initial(past_u, past_y, u[:, 0]), list[Array]()
    for k in range(u.shape[1]):
        state, y = model.step(state, u[:, k])
        outputs.append(y)
    return np.stack(outputs, axis=1)
