"""Cost of exported code: a SUBNET of 4 states and 32 units as C, ONNX and FMU in one run.

The weights are drawn, not fitted: cost and agreement do not depend on them. Prints the largest
difference from the model's own simulation, microseconds a sample, bytes, RAM and code of the C,
and the load of the machine, without which the times mean nothing.
"""

from __future__ import annotations

import os
import tempfile
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np

from asia.candidate import Context
from asia.data import Signal, Trajectory
from asia.data.segment import SimulatedSegment
from asia.export.model import ExportModel
from asia.export.pipeline import TARGETS, Ready, table, write
from asia.lowering.trace import lowered_bytes
from asia.lowering.wire import unpack
from asia.models import subnet
from asia.models._numerics.scaling import Scaling

PAST, SAMPLES = 10, 5000


def main() -> None:
    """Print the table."""
    rng = np.random.default_rng(0)
    context = Context((Signal("u"),), (Signal("y"),), 0.1, PAST, PAST)
    record = Trajectory(rng.normal(size=(500, 1)), rng.normal(size=(500, 1)), 0.1, "drawn")
    model = subnet.build(subnet.Config(states=4, width=32), context)
    params = jax.tree.map(
        lambda a: (a + 0.05 * rng.normal(size=np.shape(a))).astype(np.float32), model.params
    )
    model = replace(model, params=params, scaling=Scaling.of([record]))
    u = rng.normal(size=(PAST + SAMPLES, 1))
    past_y = rng.normal(size=(PAST, 1))
    y_hat = model.simulate(u[None, :PAST], past_y[None], u[None, PAST:])[0]
    window = SimulatedSegment(u[:PAST], past_y, u[PAST:], y_hat, y_hat=y_hat)
    low = unpack(lowered_bytes(model, PAST, PAST, 1, 1))
    assert not isinstance(low, str), low
    span = np.array([[-3.0, 3.0]])
    given = ExportModel(
        "drawn", "refit", "export", low, context.inputs, context.outputs, 0.1, span, span,
        window.part(0, 100),
    )  # fmt: skip
    print(f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores, {SAMPLES} samples")
    for name in ("c", "onnx", "fmu", "casadi", "numpy"):
        with tempfile.TemporaryDirectory() as made:
            done = write(TARGETS[name], Ready(given, (window,)), Path(made))
            lines = table(done.parity)
        print("\n".join(lines if name == "c" else lines[1:]))
    print(TARGETS["c"].print(given).sizes)


if __name__ == "__main__":
    main()
