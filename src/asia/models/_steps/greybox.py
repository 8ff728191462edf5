"""Steps of a grey-box model: one sample of its equations, and the state that it starts from."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from asia.candidate import Steps
from asia.data import Array
from asia.models._arrays import AnyArray
from asia.models._equations.config import GreyBoxStructure
from asia.models._equations.fit import FittedEquations
from asia.models._equations.initial_state import case_start
from asia.models._equations.simulate import Effects, Scales, effects, outputs, sample_by_sample


def greybox_steps(structure: GreyBoxStructure, fitted: FittedEquations) -> Steps:
    """The state: that of the equations, and the inputs that a delay still holds back."""
    model = _Equations.of(structure, fitted)

    def initial(past_u: AnyArray, past_y: AnyArray, u: AnyArray) -> Any:
        case = past_u[None], past_y[None], u[None]
        x, inputs = case_start(structure, model.scales, fitted.prior, model.z, *case)
        inputs = inputs[..., 0]
        state = model.begun(x[:, 0], inputs[0] if structure.n_fit else u)
        for k in range(structure.n_fit):
            state, _ = model.step(state, inputs[k])
        return state

    return Steps(initial, model.step)


@dataclass(frozen=True)
class _Equations:
    structure: GreyBoxStructure
    scales: Scales
    z: AnyArray
    effect: Effects
    late: Array
    """Delays of the inputs (nu,), in samples."""

    @classmethod
    def of(cls, structure: GreyBoxStructure, fitted: FittedEquations) -> _Equations:
        import jax
        import jax.numpy as jnp

        # As JAX arrays, so that functions of them are traced as those of the signals are.
        scales = Scales(*(jnp.asarray(a) for a in fitted.scales.for_rows()))
        z = jnp.asarray(fitted.z)[:, None]
        effect = effects(structure, scales, z)
        late = np.zeros(structure.nu)
        if structure.config.input_delay:
            with jax.ensure_compile_time_eval():
                known = effects(structure, fitted.scales.for_rows(), np.asarray(fitted.z)[:, None])
            late = np.asarray(known.delay)[:, 0]
        return cls(structure, scales, z, effect, late)

    def begun(self, x: AnyArray, first: AnyArray) -> Any:
        """The state with x (nx,) in its bounds, and the first input continued into the past."""
        import jax.numpy as jnp

        confine, _ = sample_by_sample(self.structure, self.scales, self.effect)
        line = jnp.repeat(first[None], int(np.ceil(self.late).max(initial=0)), axis=0)
        return confine(x[:, None, None])[:, 0, 0], line

    def step(self, state: Any, u: AnyArray) -> tuple[Any, AnyArray]:
        """One sample: the output is read before the states move."""
        import jax.numpy as jnp

        x, line = state
        known = jnp.concatenate([line, u[None]])
        held = self._acting(known)
        _, advance = sample_by_sample(self.structure, self.scales, self.effect)
        now = x[:, None, None]
        after = advance(now, held)
        y = outputs(self.structure, self.effect, now[None], held[None])
        return (after[:, 0, 0], known[1:]), y[0, :, 0, 0]

    def _acting(self, known: AnyArray) -> AnyArray:
        """The inputs (nu, 1, 1) that act now, between two samples where a delay ends there."""
        channel = np.arange(known.shape[1])
        older = known.shape[0] - 1 - np.ceil(self.late).astype(int)
        newer = np.minimum(older + 1, known.shape[0] - 1)
        later = np.ceil(self.late) - self.late
        acting = (1.0 - later) * known[older, channel] + later * known[newer, channel]
        return acting[:, None, None]
