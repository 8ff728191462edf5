"""A python-control system, and its matrices where the model is linear."""

import math
import runpy
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from asia.data.trajectory import Array
from asia.export.model import ExportModel, Printed, TrainingWindow
from asia.export.target import Answers, missing_package
from asia.export.targets.indices import slices
from asia.export.targets.numpy import NumpyTarget
from asia.lowering.evaluation import evaluate
from asia.lowering.program import LoweredModel

_SCRIPT = '''"""system: the model for python-control; start(past_u, past_y, u): its state."""

import control
import numpy as np
from model import INPUTS, OUTPUTS, SAMPLING_TIME, initial, output, update

SHAPES = {shapes!r}
ENDS = np.cumsum([int(np.prod(s)) for s in SHAPES])


def _split(x):
    parts = np.split(np.asarray(x, float), ENDS[:-1])
    return tuple(p.reshape(s) for p, s in zip(parts, SHAPES))


def _joined(parts):
    return np.concatenate([np.reshape(p, -1) for p in parts]) if parts else np.zeros(0)


def start(past_u, past_y, u):
    """The state at the first sample."""
    return _joined(initial(np.asarray(past_u), np.asarray(past_y), np.asarray(u)))


def _update(t, x, u, params):
    with np.errstate(all="ignore"):
        return _joined(update(_split(x), np.atleast_1d(u)))


def _output(t, x, u, params):
    with np.errstate(all="ignore"):
        return output(_split(x), np.atleast_1d(u))


system = control.nlsys(
    _update,
    _output,
    inputs={inputs!r},
    outputs={outputs!r},
    states=int(ENDS[-1]) if SHAPES else 0,
    dt=SAMPLING_TIME,
)
'''
_LINEAR = """
# The model is linear but for constants: x' = A x + B u + c, y = C x + D u + d.
A = np.array({a!r}).reshape({n}, {n})
B = np.array({b!r}).reshape({n}, {nu})
C = np.array({c!r}).reshape({ny}, {n})
D = np.array({d!r}).reshape({ny}, {nu})
# For deviations from a simulation: poles, margins, LQR.
linear = control.ss(A, B, C, D, SAMPLING_TIME, inputs={inputs!r}, outputs={outputs!r})
"""


class ControlTarget:
    """Target `control`: `system.py`, next to the `model.py` of the target numpy."""

    name = "control"
    usage = """```python
import control
from system import start, system         # system.linear where the model is linear
x0 = start(past_u, past_y, u[0])
response = control.input_output_response(system, t, u.T, x0)
```
`system` is a discrete-time `NonlinearIOSystem`: connect it, or linearise it with
`control.linearize`."""

    def missing(self) -> str | None:
        """Return a sentence if python-control is not installed."""
        return missing_package("control")

    def print(self, model: ExportModel) -> Printed:
        """Print the files."""
        low = model.lowered
        # Python-control refuses dots in names, and an output with the name of an input.
        inputs, outputs = (
            [s.name.replace(".", "_") for s in side] for side in (model.inputs, model.outputs)
        )
        outputs = [f"{name}_out" if name in inputs else name for name in outputs]
        text = _SCRIPT.format(shapes=list(low.states), inputs=inputs, outputs=outputs)
        found = matrices(low)
        if found is not None:
            a, b, c, d = (m.tolist() for m in found)
            text += _LINEAR.format(
                a=a, b=b, c=c, d=d, n=len(found[0]), nu=low.nu, ny=low.ny,
                inputs=inputs, outputs=outputs,
            )  # fmt: skip
        return Printed({**NumpyTarget().print(model).files, "system.py": text.encode()})

    def run(self, folder: Path, windows: Sequence[TrainingWindow]) -> list[Answers] | str:
        """Simulate with the system's own functions, sample by sample."""
        sys.path.insert(0, str(folder))
        before = sys.modules.pop("model", None)
        try:
            made = runpy.run_path(str(folder / "system.py"))
        finally:
            sys.path.remove(str(folder))
            sys.modules.pop("model", None)
            if before is not None:
                sys.modules["model"] = before
        system, y_hat = made["system"], list[Array]()
        begin = time.perf_counter()
        for window in windows:
            x, rows = made["start"](window.past_u, window.past_y, window.u[0]), list[Array]()
            for u in window.u:
                rows.append(np.asarray(system.output(0.0, x, u)))
                x = system.dynamics(0.0, x, u)
            y_hat.append(np.stack(rows))
        return [Answers("double", tuple(y_hat), time.perf_counter() - begin)]


def matrices(low: LoweredModel) -> tuple[Array, Array, Array, Array] | None:
    """Matrices A, B, C and D of a step that is affine; None for another step."""
    n = sum(math.prod(s) for s in low.states)
    if n == 0 or n > 400:
        return None

    def step(z: Array) -> Array:
        parts = zip(slices(low.states), low.states, strict=True)
        states = [z[part].reshape(shape) for part, shape in parts]
        y, *after = evaluate(low.step, [*states, z[n:]])
        return np.concatenate([*(p.reshape(-1) for p in after), y])

    zero = step(np.zeros(n + low.nu))
    slopes = np.stack([step(e) - zero for e in np.eye(n + low.nu)], axis=1)
    random = np.random.default_rng(0)
    for size in (1.0, 30.0):
        z = size * random.standard_normal(n + low.nu)
        if not np.allclose(step(z), zero + slopes @ z, rtol=1e-9, atol=1e-9):
            return None
    return slopes[:n, :n], slopes[:n, n:], slopes[n:, :n], slopes[n:, n:]
