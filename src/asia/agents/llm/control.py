"""Control problem as a language model reads it: role, signals and contract of a controller."""

from __future__ import annotations

from asia._text import one_line
from asia.agents.view import Facts
from asia.problem.metrics import metric_label

CONTROL_ROLE = """\
You are an expert in control. You search for the best controller of a plant that you know by
identified models and open-loop records only. In each turn you propose one candidate: a complete
file candidate.py. A trusted evaluator, which you cannot reach, runs its controller in closed loop
with the true plant, in held-out scenarios, sample by sample, and computes V, the {metric} of each
controlled output and of the change of each input in units of its tolerance, mean over these and
over the folds. Lower is better. Prefer the simpler of two candidates that are equally good."""

CONTROL_EXAMPLE = '''"""PI controller, its gain from the plant's identified model."""

import numpy as np

from asia.models import controllers


class Controller:
    def __init__(self, u0, gain):
        self.integral, self.gain = u0, gain

    def step(self, r, y):
        error = r[0] - y[0]
        self.integral = min(max(self.integral + 0.05 * self.gain * error, 0.0), 7.0)
        return np.array([self.integral + self.gain * error])


def design(models, context):
    start = context.control.actuators[0].start
    return Controller(start, 0.5)


# Or of the library:
#     return controllers.pid(models, context)
'''

_CONTRACT = """\
candidate.py defines design(models, context), which returns a controller with step(r, y).
- step(r, y) gets the set points r ({nr},) of this sample and the measured outputs y ({ny},) at its
  beginning, in physical units, and returns the inputs u ({nu},) for the sample. It may keep a
  state: each scenario begins with a deep copy of what design returned. It never sees a later set
  point, a disturbance or the plant.
- The plant clips u to its limits and rates, whatever step returns; NaN fails the candidate.
- models: identified models, that of all records first; each has initial(past_u, past_y, u), a
  state, and step(state, u), which returns the next state and the outputs (B, {ny}); past windows of
  {past_u} inputs and {past_y} outputs, B cases at once, in NumPy and JAX.
- context has inputs, outputs, sampling_time, physics, seed, log(step, loss) and control: setpoints,
  controlled (places among the outputs), actuators (min, max, start, rate in 1/s), tolerance, noise,
  ranges of the set points, records (open loop, u and y) and scenarios (for training: u holds the
  set points first).
- Library: controllers.pid(models, context, scheduled=False), .lqr, .mpc(..., moves=20), .relay,
  .with_residual(controller, context, hidden=3), all optimised in simulation with the models;
  arguments generations and population. You may also write a controller of your own.
- Python with numpy, scipy, jax and asia.models, one CPU thread, no network, no files. design has
  {seconds:g} s; stop by iteration counts, not by the clock. Take random numbers from context.seed.
- The controller may have parameters(), a dict of at most 64 names and floats.
- The source must carry no data: let design compute numbers from the models."""


def control_role(facts: Facts) -> str:
    """Role and score."""
    return CONTROL_ROLE.format(metric=metric_label(facts.metric))


def control_contract(facts: Facts) -> str:
    """Contract of a controller."""
    task, plant = facts.control, facts.identification
    assert task is not None
    assert plant is not None
    return _CONTRACT.format(
        nr=len(task.setpoints), ny=len(plant.outputs), nu=len(plant.inputs),
        past_u=plant.n_past_u, past_y=plant.n_past_y, seconds=facts.budget.fit_seconds,
    )  # fmt: skip


def task_lines(facts: Facts) -> str:
    """Limits, set points, tolerances and noise, a line each."""
    task, plant = facts.control, facts.identification
    assert task is not None
    assert plant is not None
    lines: list[str] = []
    for signal, a in zip(plant.inputs, task.actuators, strict=True):
        lines.append(
            f"input {one_line(signal.label, 60)}: {a.min:g} to {a.max:g}, at most {a.rate:g} in a "
            f"second, {a.start:g} at first"
        )
    for name, (low, high) in zip(task.setpoints, task.ranges, strict=True):
        lines.append(f"set point of {one_line(name, 60)}: steps between {low:g} and {high:g}")
    names = (*task.setpoints, *(f"change of {s.name} from sample to sample" for s in plant.inputs))
    for name, tolerance in zip(names, task.tolerance, strict=True):
        lines.append(f"tolerance of {one_line(name, 80)}: {tolerance:g}")
    for signal, noise in zip(plant.outputs, task.noise, strict=True):
        lines.append(f"measurement noise of {one_line(signal.name, 60)}: {noise:g}")
    return "\n".join(lines)
