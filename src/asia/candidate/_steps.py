"""State-space step contract of a fitted model, used for simulation and for `asia export`."""

from __future__ import annotations

from typing import Any, Protocol, runtime_checkable

import numpy as np

from asia.data import Array


@runtime_checkable
class StepModel(Protocol):
    """Fitted model that simulates sample by sample, in physical units, for a batch of B cases.

    Both methods compute with NumPy arrays, and with JAX arrays where they are traced (`asia
    export`): they choose nothing by the values of signals. A state is any tree (tuples, lists,
    dicts) of arrays (B, ...) whose shapes stay the same; constants of float64 keep their precision.
    The result for a row depends on that row only.
    """

    def initial(self, past_u: Any, past_y: Any, u: Any) -> Any:
        """State at the first sample, continued into the past by models that need it.

        Args:
            past_u: past inputs (B, n_past_u, nu).
            past_y: past outputs (B, n_past_y, ny).
            u: input (B, nu) of the first sample.
        """
        ...

    def step(self, state: Any, u: Any) -> tuple[Any, Any]:
        """Advance the state by one sample.

        Args:
            state: state at this sample.
            u: input (B, nu) of this sample.

        Returns:
            State at the next sample, and the output (B, ny) of this one.
        """
        ...


def simulate_steps(model: StepModel, past_u: Array, past_y: Array, u: Array) -> Array:
    """Simulate step by step: the `simulate` of a model that has no faster one.

    Args:
        model: fitted model.
        past_u: past inputs (B, n_past_u, nu).
        past_y: past outputs (B, n_past_y, ny).
        u: inputs (B, H, nu), H at least 1.

    Returns:
        Outputs (B, H, ny).
    """
    state, outputs = model.initial(past_u, past_y, u[:, 0]), list[Array]()
    for k in range(u.shape[1]):
        state, y = model.step(state, u[:, k])
        outputs.append(y)
    return np.stack(outputs, axis=1)
