"""Control problem of a run: its models are the plant, its records those of the identification."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from asia._text import suggestion
from asia.data.preprocess import Preprocess
from asia.data.trajectory import Array, Signal, Trajectory
from asia.errors import UserError
from asia.export.linear import LinearPoint, LinearRun, linearize
from asia.export.pipeline import kept_delays
from asia.export.targets.numpy import model_functions
from asia.judge.sandbox.types import Isolation
from asia.ledger.run import open_run
from asia.lowering.linear import LinearModel, split
from asia.problem.create import RecordRows, check_directory, write_directory
from asia.problem.load import load_lock
from asia.problem.problem import Problem
from asia.problem.toml import toml_text
from asia.search.run import LOCK

_MODEL = "plant_model"
# Set points and inputs stay within these shares of the standard deviation of the records, and of
# the room between the operating point and the limits.
_SPREAD, _ROOM = 1.5, 0.7
# Settling time in samples: the least and the most; hold and length of a scenario in it.
_SETTLING, _HOLD, _LENGTH = (12, 120), 2.5, 8.0
_DISTURBANCE = (5.0, 95.0)
_HEADER = """\
# Written by asia init from run {run}.
# plant.py holds {count} of its models; each scenario draws one. Limits and start of the inputs are
# range and mean of the records. Set points are a range that the linear model reaches with
# {room:.0%} of the inputs. Noise is that of the residuals. Change what is not so.
"""
_PLANT = '''"""Plant: models of run {run}, in open loop.

{names}. params["{parameter}"] picks one by its number, from 0.
Inputs: {inputs}. Outputs: {outputs}.
It begins {rest}.
"""

import numpy as np

{models}
MODELS = [{calls}]
RESTS = {rests}  # states with the inputs at their mean
# Whether an output has the input of its own sample: then it is the output at the end of it.
DIRECT = {direct}
ORDER = {order}  # place in u of each input of the models
SETTLING = {settling}  # most samples to rest


def step(x, u, params, dt):
    k = min(int(params["{parameter}"]), len(MODELS) - 1)
    (output, update, advance), u = MODELS[k], np.asarray(u, float)[ORDER]
    with np.errstate(all="ignore"):
        if x is None:
            x = tuple(np.array(part) for part in RESTS[k])
            for _ in range(SETTLING):
                after = update(x, u)
                near = all(np.allclose(a, b, 1e-9, 1e-12) for a, b in zip(after, x))
                x = after
                if near:
                    break
            return x, output(x, u)
        if DIRECT[k]:
            y, x = advance(x, u)
            return x, y
        x = update(x, u)
        return x, output(x, u)
'''


@dataclass(frozen=True)
class NewControlProblem:
    """Control problem that was written."""

    path: Path
    """problem.toml."""
    lines: tuple[str, ...]
    """Plant and ranges, a sentence each."""


def control_problem_of_run(
    directory: Path,
    run: Path,
    inputs: Sequence[str] = (),
    outputs: Sequence[str] = (),
    *,
    isolation: Isolation | None = None,
) -> NewControlProblem:
    """Write a control problem whose plant is the refit and the fold models of a run.

    Args:
        directory: folder of the new problem.
        run: folder of the run.
        inputs: inputs that the controller gives, others are disturbances; empty for all.
        outputs: outputs with a set point, others are measured only; empty for all.
        isolation: level of the candidate; None for the strongest of this machine.

    Raises:
        UserError: for a model without a step, and signals that make no control problem.
    """
    directory = directory.resolve()
    check_directory(directory)
    opened = open_run(run)
    problem = load_lock(opened.directory / LOCK)
    if problem.channels.time_step is not None:
        raise UserError(
            f"run '{opened.name}' has irregular samples: a control loop needs even ones"
        )
    if problem.control is not None:
        raise UserError(f"run '{opened.name}' searched for a controller: name a run of its plant")
    driven = _named("--inputs", inputs, problem.inputs)
    controlled = _named("--outputs", outputs, problem.outputs)
    if len(controlled) > len(driven):
        raise UserError(
            f"{len(controlled)} outputs cannot have a set point with {len(driven)} inputs: name "
            f"at most {len(driven)} of {', '.join(s.name for s in controlled)} in --outputs"
        )
    found = linearize(opened, isolation=isolation)
    ranges = _Ranges(problem, found, driven, controlled)
    plant = _plant(found, [*ranges.driven, *ranges.disturbing])
    count = len(found.points[0].steps)
    tables = _tables(directory.name, problem, ranges, count)
    header = _HEADER.format(run=opened.name, count=count, room=_ROOM)
    names = [s.name for s in (*driven, *problem.outputs)]
    columns = [problem.inputs.index(s) for s in driven]
    records = [_measured(r, problem.preprocess, problem.inputs) for r in problem.train]
    files: dict[str, str | bytes | RecordRows] = {
        f"record{k}.csv": RecordRows(
            Trajectory(r.u[:, columns], r.measured_y, r.sampling_time, r.name), names
        )
        for k, r in enumerate(records, 1)
    }
    files["plant.py"] = plant
    files["description.md"] = problem.description or f"Plant: models of run {opened.name}.\n"
    files["problem.toml"] = header + toml_text(tables)
    write_directory(directory, files)
    return NewControlProblem(directory / "problem.toml", tuple(ranges.lines(count)))


def _named(option: str, names: Sequence[str], signals: Sequence[Signal]) -> list[Signal]:
    """Signals of these names; all without names."""
    known = [s.name for s in signals]
    for name in names:
        if name not in known:
            raise UserError(f"{option}: the run has no '{name}'{suggestion(name, known)}")
    return [s for s in signals if not names or s.name in names]


def _measured(record: Trajectory, done: Preprocess, inputs: Sequence[Signal]) -> Trajectory:
    """Record with the inputs as measured; it is shorter by the longest delay."""
    late = kept_delays(done, inputs)
    kept = len(record) - max(late)
    u = np.stack([record.u[d : d + kept, k] for k, d in enumerate(late)], axis=1)
    return Trajectory(u, record.measured_y[:kept], record.sampling_time, record.name)


def _rounded(value: float) -> float:
    return float(f"{value:.4g}")


class _Ranges:
    """Ranges of the signals of the new problem."""

    def __init__(
        self,
        problem: Problem,
        found: LinearRun,
        driven: Sequence[Signal],
        controlled: Sequence[Signal],
    ) -> None:
        self.point, self.driven = found.points[0], list(driven)
        self.disturbing = [s for s in problem.inputs if s not in self.driven]
        columns = [problem.inputs.index(s) for s in driven]
        rows = [problem.outputs.index(s) for s in controlled]
        u = np.concatenate([r.u for r in problem.train])
        y = np.concatenate([r.measured_y for r in problem.train])
        linear, dt = self.point.model, problem.sampling_time
        self.actuators: dict[str, Any] = {}
        for s, k in zip(driven, columns, strict=True):
            low, high = (_rounded(float(v)) for v in (u[:, k].min(), u[:, k].max()))
            if not low < high:
                raise UserError(f"input '{s.name}' is constant in the records: leave it out")
            start = min(max(_rounded(float(self.point.at.u[k])), low), high)
            self.actuators[s.name] = {"min": low, "max": high, "start": start}
        settling = _settling(linear)
        hold = _rounded(_HOLD * settling * dt)
        self.samples = max(round(_LENGTH * settling), 60)
        spread = np.nanstd(y, axis=0)[rows]
        half = spread * self._share(linear.gain[rows][:, columns], spread)
        self.setpoints, self.tolerance = dict[str, Any](), dict[str, float]()
        for s, k, room in zip(controlled, rows, half, strict=True):
            middle, noise = float(self.point.at.y[k]), float(found.noise[k])
            low, high = (_rounded(middle + side * float(room)) for side in (-1, 1))
            self.setpoints[s.name] = {"min": low, "max": high, "hold": hold}
            self.tolerance[s.name] = _rounded(max(0.2 * float(room), 2.0 * noise))
        places = zip(problem.outputs, found.noise.tolist(), strict=True)
        self.noise = {s.name: _rounded(value) for s, value in places if value > 0}
        self.disturbances: dict[str, Any] = {}
        for s in self.disturbing:
            column = u[:, problem.inputs.index(s)]
            low, high = (_rounded(float(v)) for v in np.percentile(column, _DISTURBANCE))
            self.disturbances[s.name] = {"min": low, "max": high, "hold": hold}
            if s.unit:
                self.disturbances[s.name]["unit"] = s.unit

    def _share(self, gain: Array, spread: Array) -> float:
        """Largest share of the spread of the outputs that all set points together may move by."""
        if not np.isfinite(gain).all():
            return _SPREAD
        needed = np.abs(np.linalg.pinv(gain)) @ spread
        each = self.actuators.values()
        room = np.array([min(a["start"] - a["min"], a["max"] - a["start"]) for a in each])
        limits = room[needed > 0] / needed[needed > 0]
        return min(_SPREAD, _ROOM * float(limits.min())) if limits.size else _SPREAD

    def lines(self, count: int) -> list[str]:
        """Plant and ranges in words."""
        found = [f"plant    {count} models of the run, one drawn for each scenario"]
        for s, a in self.actuators.items():
            found.append(f"input    {s} {a['min']:g} to {a['max']:g}, from {a['start']:g}")
        for s, r in self.setpoints.items():
            found.append(
                f"setpoint {s} {r['min']:g} to {r['max']:g}; an error of {self.tolerance[s]:g} "
                f"costs 1; noise {self.noise.get(s, 0.0):g}"
            )
        for s, r in self.disturbances.items():
            found.append(f"disturbs {s} {r['min']:g} to {r['max']:g}")
        if not self.point.rests:
            found.append("note     the model has no rest: it begins where constant inputs take it")
        return found


def _settling(model: LinearModel) -> float:
    """Settling time of the slowest stable mode, in samples, within limits."""
    size = np.abs(model.poles)
    stable = size[(size > 0) & (size < 1)]
    samples = -4.0 / np.log(float(stable.max())) if stable.size else 0.0
    return float(np.clip(samples, *_SETTLING))


def _signal(signal: Signal) -> dict[str, Any]:
    return {key: value for key, value in asdict(signal).items() if value}


def _tables(name: str, problem: Problem, ranges: _Ranges, count: int) -> dict[str, Any]:
    """Tables of problem.toml."""
    physics = None if ranges.disturbances or not problem.physics else asdict(problem.physics)
    parameters = {_MODEL: {"min": 0.0, "max": float(count)}} if count > 1 else None
    return {
        "name": name,
        "sampling_time": problem.sampling_time,
        "inputs": [_signal(s) for s in ranges.driven],
        "outputs": [_signal(s) for s in problem.outputs],
        "data": {"train": [f"record{k}.csv" for k in range(1, 1 + len(problem.train))]},
        "protocol": {
            "kind": "control",
            "metric": "rmse",
            "past_inputs": problem.protocol.past_inputs,
            "past_outputs": problem.protocol.past_outputs,
        },
        "budget": {"experiments": 6, "fit_seconds": 900, "memory_mb": 4096, "retests": 0},
        "plant": {"source": "plant.py:step", "parameters": parameters},
        "control": {
            "actuators": ranges.actuators,
            "setpoints": ranges.setpoints,
            "disturbances": ranges.disturbances or None,
            "noise": ranges.noise or None,
            "tolerance": ranges.tolerance,
            "scenarios": {"samples": ranges.samples, "train": 4, "folds": 2, "test": 4},
        },
        "physics": physics,
    }


def _plant(found: LinearRun, order: Sequence[Signal]) -> str:
    """plant.py: a function `step` of all models."""
    point: LinearPoint = found.points[0]
    names = ["model", *(f"fold_{k}" for k in range(1, len(point.steps)))]
    models: list[str] = []
    for name, (low, _) in zip(names, point.steps, strict=True):
        body = textwrap.indent("\n".join(model_functions(low)).strip(), "    ")
        models.append(f"def {name}():\n{body}\n\n    return output, update, step\n\n")
    linear = (point.model, *point.folds)

    def listed(signals: Sequence[Signal]) -> str:
        return re.sub(r"[^A-Za-z0-9 _.,:-]", "_", ", ".join(s.name for s in signals))

    return _PLANT.format(
        run=found.name,
        names=f"`{names[0]}` is the {found.use}"
        + (f", {', '.join(f'`{n}`' for n in names[1:])} are its fold models" if names[1:] else ""),
        inputs=listed(order),
        outputs=listed(found.outputs),
        rest="at rest" if point.rests else "where constant inputs take it, for want of rest",
        models="\n".join(models),
        calls=", ".join(f"{n}()" for n in names),
        rests=[[part.tolist() for part in split(low, at.x)] for low, at in point.steps],
        direct=[bool((model.delay == 0).any()) for model in linear],
        order=[[s.name for s in order].index(s.name) for s in found.inputs],
        settling=2_000 if point.rests else 0,
        parameter=_MODEL,
    )
