"""Simulator of the user's own ([plant] in the problem file), calibrated to the records.

    model = simulator.build(simulator.Config(), context)
    method = LevenbergMarquardt(iterations=30, starts=4)
    model = simulator.train(model, trajectories, context, method)

The simulator is a black box: the fit calls it and nothing else. All unknowns are scaled to their
ranges, positive ones on a log scale. Where finite differences of two sizes agree, the sum of
squares is minimised by a trust-region method with bounds; elsewhere, as in a simulator that rounds
or chooses its steps, by differential evolution. Sources: Branch, Coleman and Li, SIAM J. Sci.
Comput. 21, 1999; Storn and Price, J. Global Optimization 11, 1997.
"""

from __future__ import annotations

import contextlib
import ctypes.util
import io
import sys
import time
import weakref
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from types import ModuleType
from typing import Any, Literal, TypeAlias, get_args

import numpy as np

from asia.candidate import Context, ParameterEstimate, ParameterEstimates
from asia.data.trajectory import Array, Intersample, Signal, Trajectory
from asia.models import linear, neural_ss, uncertainty
from asia.models._config import check_choice
from asia.models._least_squares import LevenbergMarquardt
from asia.models._numerics.intersample import Between, between
from asia.models._numerics.training_records import measured_weight
from asia.models._steps import FittedModel
from asia.problem.plant import Plant, Unknown

__all__ = ["Config", "Simulator", "build", "probe", "train"]

Search = Literal["auto", "gradient", "global"]
ResidualModel = Literal["linear", "neural_ss"]
SimulateFunction: TypeAlias = Callable[[Array, Mapping[str, float], Mapping[str, float]], Array]
"""Outputs (T, ny) from inputs (T, nu), parameters and initial states."""

# Steps of differences, in units of a range; the first whose derivatives agree with those of steps
# three times as large is taken.
_STEPS = (1e-4, 1e-3, 1e-2, 3e-2)
_AGREEMENT, _WIDE = 0.1, _STEPS[2:]
# Held parts of a sample that stand for an input that moves between samples.
_PARTS = 8
# Error, in standard deviations of the output, that stands for a simulation that failed.
_FAILED = 1e3
# Points drawn for each start of a search.
_DRAWS = 8
# Windows of the training records that initial states are regressed on, and samples of each beyond
# its past window.
_WINDOWS, _AHEAD = 20, 50
_MOST_INITIAL_STEPS = 12
# Lines that a failed simulation printed last, and characters of them, for its message.
_PRINTED_LINES, _PRINTED = 3, 300
# Singular values below this share of the largest belong to the null space: differences have errors.
_NULL = 1e-4


class SimulatorError(RuntimeError):
    """A simulation that failed, in one sentence."""


@dataclass(frozen=True)
class Config:
    """Search for the unknowns of the simulator, and the model of what it leaves."""

    search: Search = "auto"
    """"gradient" uses finite differences from several starts. "global" is differential evolution:
    `iterations` of the method are generations, and `starts` individuals for each unknown. "auto"
    takes "gradient" where finite differences are reliable."""
    residual: ResidualModel | None = None
    """Family that is fitted to the error of the calibrated simulator, with the inputs and the
    simulated outputs as its inputs; None leaves it out."""
    intersample: Intersample | None = None
    """As in `greybox.Config`. The simulator is called with an eighth of the sampling time and the
    inputs held at the middle of each part; an FMU that ASIA exported cannot be."""

    def __post_init__(self) -> None:
        check_choice(self, "intersample", (None, *get_args(Intersample)))
        check_choice(self, "search", get_args(Search))
        check_choice(self, "residual", (None, *get_args(ResidualModel)))


@dataclass(frozen=True)
class _Calibration:
    """Result of a fit; coordinates are places in the ranges, from 0 to 1."""

    z: Array  # Parameters (P,)
    starts: Array  # Initial states of each training record (R, Q)
    step: float  # Step of differences
    reliable: bool  # Whether these are derivatives
    scale: Array  # Standard deviation of each output (ny,)
    error: Array  # Standard deviation of its residual (ny,)
    center: Array  # Mean of past windows (F,)
    spread: Array  # Standard deviation of past windows (F,)
    weights: Array  # Map from past windows to the initial state (1 + F, Q)
    deviation: Array  # Standard deviation of its error (Q,)
    residual: FittedModel | None = None


@dataclass(frozen=True)
class Simulator:
    """Calibrated simulator; `fitted` is None until it is trained."""

    config: Config
    plant: Plant
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    sampling_time: float
    n_past_u: int
    n_past_y: int
    fitted: _Calibration | None = None
    between: Between | None = None
    """Inputs between samples; None holds them, as in older models."""
    time_step: int | None = None
    """Input that holds the time to the next sample; None for one sampling time."""

    def simulate(self, past_u: Array, past_y: Array, u: Array) -> Array:
        """Simulate in open loop, in physical units, from the start of the past window.

        Declared initial states are estimated from the past window; a simulator without them starts
        there from its own.

        Args:
            past_u: past inputs (B, n_past_u, nu).
            past_y: past outputs (B, n_past_y, ny).
            u: inputs (B, H, nu).

        Returns:
            Outputs (B, H, ny).

        Raises:
            ValueError: before training.
            SimulatorError: for a simulation that fails.
        """
        fitted = self._trained()
        before = self.n_past
        held = np.repeat((past_u if past_u.shape[1] else u)[:, :1], before - past_u.shape[1], 1)
        inputs = np.concatenate([held, past_u, u], axis=1)
        found: list[Array] = []
        for known, past in zip(inputs, past_y, strict=True):
            start = self._start(fitted, known[:before], past)
            found.append(self.run(known, fitted.z, start))
        y = np.stack(found)
        if fitted.residual is None:
            return y[:, before:]
        windows, n_u, n_y = np.concatenate([inputs, y], axis=2), self.n_past_u, self.n_past_y
        left = past_y - y[:, before - n_y : before]
        past = windows[:, before - n_u : before]
        return y[:, before:] + fitted.residual.simulate(past, left, windows[:, before:])

    def parameters(self) -> dict[str, float]:
        """Calibrated parameters."""
        return self._named(self.plant.parameters, self._trained().z)

    def estimates(self, trajectories: Sequence[Trajectory], context: Context) -> ParameterEstimates:
        """Estimate the uncertainty of the parameters from the records of the fit; initial states
        are estimated with them.

        Raises:
            ValueError: if finite differences of the simulator are no derivatives.
        """
        del context
        fitted, count = self._trained(), len(self.plant.parameters)
        if not fitted.reliable:
            raise ValueError("finite differences of the simulator are unreliable")
        error = _SimulationError(self, trajectories)
        theta = np.concatenate([fitted.z, fitted.starts.ravel()])
        parts = error.jacobians(theta, fitted.step)
        lengths = [record.y.shape for record in trajectories]
        residuals = [e.reshape(s) for e, s in zip(error.errors(theta), lengths, strict=True)]
        slopes = [j.reshape(*s, -1) for j, s in zip(parts, lengths, strict=True)]
        covariance = uncertainty.sandwich(
            residuals,
            [j[..., :count] for j in slopes],
            nuisance=[j[..., count:] for j in slopes] if self.plant.initial else None,
            measured=[measured_weight(record) for record in trajectories],
        )

        def report(z: Array) -> list[ParameterEstimate]:
            values = self._named(self.plant.parameters, z)
            return [
                ParameterEstimate(name, values[name], np.nan, np.nan, np.nan, p.unit, p.min, p.max)
                for name, p in self.plant.parameters.items()
            ]

        return uncertainty.estimates(covariance, report, fitted.z)

    @property
    def n_past(self) -> int:
        """Samples of the past window."""
        return max(self.n_past_u, self.n_past_y)

    def _named(self, table: Mapping[str, Unknown], z: Array) -> dict[str, float]:
        """Values at coordinates."""
        found: dict[str, float] = {}
        for (name, one), place in zip(table.items(), z.tolist(), strict=True):
            if one.min > 0:
                found[name] = float(one.min * (one.max / one.min) ** place)
            else:
                found[name] = float(one.min + (one.max - one.min) * place)
        return found

    def run(self, u: Array, z: Array, start: Array) -> Array:
        """Simulate one record u (T, nu) at coordinates: outputs (T, ny)."""
        u, parts = self._in_parts(u)
        call = _function(self.plant, self.inputs, self.outputs, self.sampling_time / parts)
        parameters = self._named(self.plant.parameters, z)
        initial = self._named(self.plant.initial, start)
        shown = ", ".join(f"{k}={v:.4g}" for k, v in (parameters | initial).items())
        printed = io.StringIO()
        try:
            with contextlib.redirect_stdout(printed):
                y = np.array(call(u.copy(), parameters, initial), dtype=np.float64)
        except Exception as error:
            raise SimulatorError(
                f"[plant] {self.plant.label} failed at {shown}: {type(error).__name__}: {error}"
                f"{_last_lines(printed)}"
            ) from error
        y = y[:, None] if y.ndim == 1 else y
        expected = (len(u), len(self.outputs))
        if y.shape != expected:
            raise SimulatorError(
                f"[plant] {self.plant.label} returned an array of shape {y.shape}, expected "
                f"{expected}: a row for each input sample, a column for each output"
                f"{_last_lines(printed)}"
            )
        wrong = np.flatnonzero(~np.isfinite(y).all(axis=1))
        if len(wrong):
            raise SimulatorError(
                f"[plant] {self.plant.label} returned NaN or infinity at sample {wrong[0] + 1} "
                f"with {shown}{_last_lines(printed)}"
            )
        return y[::parts]

    def _in_parts(self, u: Array) -> tuple[Array, int]:
        """Inputs (T, nu) in equal parts of each sample, and the number of parts: the samples
        themselves where the inputs are held."""
        if self.between is None or not self.between.memory:
            return u, 1
        windows = np.moveaxis(self.between.windows(u), 0, -1)
        found = self.between.stages(windows, _PARTS)[:, 1]
        # At a sample its own input, which alone may act on its output.
        found[0] = u.T
        fine = np.moveaxis(found, -1, 0).reshape(-1, u.shape[1])[: 1 - _PARTS]
        if self.time_step is not None:
            fine[:, self.time_step] /= _PARTS
        return fine, _PARTS

    def _start(self, fitted: _Calibration, u: Array, past_y: Array) -> Array:
        """Most probable initial state (Q,) at the start of a past window."""
        window = np.concatenate([u.ravel(), past_y.ravel()])
        shape = (window - fitted.center) / fitted.spread
        expected = np.clip(np.concatenate([[1.0], shape]) @ fitted.weights, 0.0, 1.0)
        if not len(past_y) or not self.plant.initial:
            return expected
        return self.fit_start(fitted, u, past_y, expected, fitted.deviation)

    def fit_start(
        self, fitted: _Calibration, u: Array, y: Array, expected: Array, deviation: Array
    ) -> Array:
        """Initial state (Q,) that explains the last outputs y, NaN where they were not measured."""
        from scipy.optimize import least_squares

        # Shifted by 1: the steps of differences are relative.
        def errors(shifted: Array) -> Array:
            start = np.clip(shifted - 1.0, 0.0, 1.0)
            e = (self.run(u, fitted.z, start)[len(u) - len(y) :] - y) / fitted.error
            return np.concatenate([np.nan_to_num(e).ravel(), (start - expected) / deviation])

        found = least_squares(
            errors,
            1.0 + np.clip(expected, 1e-6, 1 - 1e-6),
            bounds=(1.0, 2.0),
            diff_step=fitted.step,
            max_nfev=_MOST_INITIAL_STEPS,
        )
        return np.asarray(found.x, np.float64) - 1.0

    def _trained(self) -> _Calibration:
        if self.fitted is None:
            raise ValueError("simulator: the model is not trained; call simulator.train first")
        return self.fitted


def _last_lines(printed: io.StringIO) -> str:
    """Join the last lines that a simulator printed; "" where it printed nothing."""
    text = " | ".join(printed.getvalue().strip().splitlines()[-_PRINTED_LINES:])
    return f"; it printed: {text[-_PRINTED:]}" if text else ""


@lru_cache(4)
def _loaded(code: bytes, function: str) -> Any:
    """Execute the user's file as module `plant`."""
    module = ModuleType("plant")
    module.__file__ = "plant.py"
    sys.modules["plant"] = module
    exec(compile(code, "plant.py", "exec", dont_inherit=True), module.__dict__)
    return module.__dict__[function]


def _function(
    plant: Plant, inputs: tuple[str, ...], outputs: tuple[str, ...], sampling_time: float
) -> SimulateFunction:
    if plant.is_unit:
        return _unit_function(plant, inputs, outputs, sampling_time)
    simulate = _loaded(plant.code, plant.function)
    return lambda u, parameters, initial: simulate(u, parameters, initial, sampling_time)


def _described(plant: Plant) -> tuple[Any, Any]:
    """fmpy, and its description of an FMU."""
    # fmpy asks a compiler for the C library, which no sandbox runs; None is this process, with it.
    find, ctypes.util.find_library = ctypes.util.find_library, lambda name: None
    try:
        import fmpy
    except ImportError as error:
        raise SimulatorError(
            "an FMU needs fmpy: pip install '.[fmu]' in a clone of ASIA"
        ) from error
    finally:
        ctypes.util.find_library = find
    return fmpy, fmpy.read_model_description(str(plant.folder), validate=False)


def _held_inputs(
    described: Any, names: Sequence[str], u: Array, times: Array, parameters: Mapping[str, float]
) -> Any:
    """Inputs of an FMU at times (T,): u (T, nu), and of those that no record has parameters or
    their start values."""
    driven = [v for v in described.modelVariables if v.causality == "input"]
    signals = np.zeros(len(times), [("time", np.float64), *((v.name, np.float64) for v in driven)])
    signals["time"] = times
    for v in driven:
        signals[v.name] = parameters.get(v.name, float(v.start or 0.0))
    for name, column in zip(names, u.T, strict=True):
        signals[name] = column
    return signals


def _unit_function(
    plant: Plant, inputs: tuple[str, ...], outputs: tuple[str, ...], sampling_time: float
) -> SimulateFunction:
    """Simulate an FMU with a communication step of one sample; inputs are held."""
    fmpy, described = _described(plant)
    # A unit of ASIA gives the output of a sample after the step.
    late = int(described.generationTool == "ASIA")
    if late and not np.isclose(float(described.defaultExperiment.stepSize), sampling_time):
        raise SimulatorError(
            "an FMU that ASIA exported steps by its own sampling time: give its inputs "
            'intersample = "zero"'
        )
    kind = "CoSimulation" if described.coSimulation is not None else "ModelExchange"

    def simulate(u: Array, parameters: Mapping[str, float], initial: Mapping[str, float]) -> Array:
        held = np.concatenate([u, u[-1:]])[: len(u) + late]
        times = np.arange(len(held), dtype=np.float64) * sampling_time
        rows: Any = fmpy.simulate_fmu(
            str(plant.folder),
            validate=False,
            start_time=0.0,
            stop_time=times[-1],
            step_size=sampling_time,
            output_interval=sampling_time,
            record_events=False,
            fmi_type=kind,
            start_values={**parameters, **initial},
            input=_held_inputs(described, inputs, held, times, parameters),
            output=list(outputs),
            model_description=described,
        )
        return np.stack([rows[name][late : late + len(u)] for name in outputs], axis=1)

    return simulate


class _SimulationError:
    """Errors of records at coordinates: parameters (P,), then the initial states (R, Q) of each."""

    def __init__(self, model: Simulator, records: Sequence[Trajectory]) -> None:
        self.model, self.records = model, records
        self.count, self.initial = len(model.plant.parameters), len(model.plant.initial)
        y = np.concatenate([np.where(r.measured, r.y, np.nan) for r in records])
        spread = np.nanstd(y, axis=0)
        self.scale = np.where(spread > 0, spread, 1.0)
        self.size = self.count + self.initial * len(records)
        self.failure: SimulatorError | None = None

    def starts(self, theta: Array) -> Array:
        """Initial states (R, Q)."""
        return theta[self.count :].reshape(len(self.records), self.initial)

    def errors(self, theta: Array) -> list[Array]:
        """Errors (T ny,) of each record in standard deviations, 0 where nothing was measured."""
        found: list[Array] = []
        for record, start in zip(self.records, self.starts(theta), strict=True):
            try:
                y = self.model.run(record.u, theta[: self.count], start)
                e = np.where(record.measured, (y - record.y) / self.scale, 0.0)
                found.append(np.clip(e, -_FAILED, _FAILED).ravel())
            except SimulatorError as error:
                self.failure = error
                found.append(np.full(record.y.size, _FAILED))
        return found

    def cost(self, theta: Array) -> float:
        """Mean squared error."""
        e = np.concatenate(self.errors(theta))
        return float(e @ e / len(e))

    def jacobians(self, theta: Array, step: float) -> list[Array]:
        """Derivatives (T ny, P + Q) of the errors of each record by the parameters and its own
        initial state, which moves in all records at once."""
        columns: list[list[Array]] = []
        for k in range(self.count + self.initial):
            places = [k] if k < self.count else range(k, self.size, self.initial)
            up, down = theta.copy(), theta.copy()
            up[places] = np.minimum(theta[places] + step, 1.0)
            down[places] = np.maximum(theta[places] - step, 0.0)
            width = (up - down)[places]
            widths = np.full(len(self.records), width[0]) if k < self.count else width
            pairs = zip(self.errors(up), self.errors(down), widths.tolist(), strict=True)
            columns.append([(a - b) / w for a, b, w in pairs])
        return [np.stack(record, axis=1) for record in zip(*columns, strict=True)]

    def jacobian(self, theta: Array, step: float) -> Array:
        """Derivatives of all errors by all coordinates."""
        parts, row = self.jacobians(theta, step), 0
        found = np.zeros((sum(map(len, parts)), self.size))
        for k, part in enumerate(parts):
            rows = slice(row, row := row + len(part))
            own = self.count + k * self.initial
            found[rows, : self.count] = part[:, : self.count]
            found[rows, own : own + self.initial] = part[:, self.count :]
        return found

    def reliable_step(self, theta: Array) -> float | None:
        """Least step of differences whose derivatives agree with those of a larger one; None where
        none does."""
        theta = np.clip(theta, 0.1, 0.9)
        widest = np.linalg.norm(self.jacobian(theta, 3 * _STEPS[-1]), axis=0)
        for step in _STEPS:
            near, far = (self.jacobian(theta, size) for size in (step, 3 * step))
            apart, size = np.linalg.norm(near - far, axis=0), np.linalg.norm(far, axis=0)
            if ((apart <= _AGREEMENT * size) & ((size > 0) | (widest == 0))).all():
                return step
        return None


def build(config: Config, context: Context) -> Simulator:
    """Build an untrained model.

    Raises:
        ValueError: if the problem has no simulator.
    """
    if context.plant is None:
        raise ValueError("simulator: the problem has no [plant]; name a simulator, or use a family")
    return Simulator(
        config,
        context.plant,
        tuple(s.name for s in context.inputs),
        tuple(s.name for s in context.outputs),
        context.sampling_time,
        context.n_past_u,
        context.n_past_y,
        time_step=next((i for i, s in enumerate(context.inputs) if s.role == "time_step"), None),
    )


def train(
    model: Simulator,
    trajectories: Sequence[Trajectory],
    context: Context,
    method: LevenbergMarquardt,
) -> Simulator:
    """Fit the parameters to the simulation error of whole records, with the initial states of each.

    Raises:
        SimulatorError: if no simulation succeeds.
    """
    acting = between(context.inputs, trajectories, model.config.intersample)
    model = replace(model, between=acting)
    error = _SimulationError(model, trajectories)
    points = _draws(error, _DRAWS * method.starts, context.seed)
    costs = np.array([error.cost(point) for point in points])
    if error.failure is not None and costs.min() >= 0.99 * _FAILED**2:
        raise error.failure
    best = points[np.argsort(costs, kind="stable")]
    reliable = error.reliable_step(best[0])
    step = reliable or _STEPS[-1]
    if model.config.search == "global" or (model.config.search == "auto" and not reliable):
        # Wide differences smooth over small jumps, and find where to search without them.
        found = [_descended(error, p, s, method) for s in _WIDE for p in best[: method.starts]]
        theta = _evolved(error, min(found, key=error.cost), method, context)
        found = [theta, *(_descended(error, theta, s, method) for s in _WIDE)]
        theta = min(found, key=error.cost)
    else:
        found = [_descended(error, p, step, method) for p in best[: method.starts]]
        theta = min(found, key=error.cost)
    context.log(float(method.iterations), error.cost(theta))
    found = _calibration(model, error, theta, step)
    model = replace(model, fitted=replace(found, reliable=reliable is not None))
    assert model.fitted is not None
    if model.config.residual is None:
        return model
    family: Any = linear if model.config.residual == "linear" else neural_ss
    left: list[Trajectory] = []
    for record, start in zip(trajectories, model.fitted.starts, strict=True):
        y = model.run(record.u, model.fitted.z, start)
        u = np.concatenate([record.u, y], axis=1)
        left.append(replace(record, u=u, y=record.y - y))
    simulated = tuple(Signal(f"simulated {s.name}", s.unit) for s in context.outputs)
    inside = replace(context, inputs=(*context.inputs, *simulated), plant=None, physics=None)
    residual = family.train(family.build(family.Config(), inside), left, inside, method)
    return replace(model, fitted=replace(model.fitted, residual=residual))


def _draws(error: _SimulationError, count: int, seed: int) -> Array:
    """Starting points (count, n), the middle of the ranges first; initial states in the middle."""
    random = np.random.default_rng(seed)
    points = np.full((count, error.size), 0.5)
    for column in points[1:, : error.count].T:
        # A Latin hypercube.
        column[:] = (random.permutation(count - 1) + random.uniform(size=count - 1)) / (count - 1)
    return points


def _descended(
    error: _SimulationError, start: Array, step: float, method: LevenbergMarquardt
) -> Array:
    from scipy.optimize import least_squares

    jacobian: Any = partial(error.jacobian, step=step)
    found = least_squares(
        lambda theta: np.concatenate(error.errors(theta)),
        np.clip(start, 1e-6, 1 - 1e-6),
        jacobian,
        bounds=(0.0, 1.0),
        max_nfev=max(method.iterations, 1),
        ftol=max(method.tolerance, 1e-12),
        xtol=1e-10,
    )
    return np.asarray(found.x, np.float64)


def _evolved(
    error: _SimulationError, start: Array, method: LevenbergMarquardt, context: Context
) -> Array:
    from scipy.optimize import differential_evolution

    found = differential_evolution(
        error.cost,
        [(0.0, 1.0)] * error.size,
        x0=start,
        maxiter=method.iterations,
        popsize=max(method.starts, 5),
        tol=1e-6,
        polish=False,
        rng=np.random.default_rng(context.seed),
    )
    return np.asarray(found.x, np.float64)


def _calibration(
    model: Simulator, error: _SimulationError, theta: Array, step: float
) -> _Calibration:
    """Result of a fit, with the regression of initial states on past windows."""
    e = np.concatenate([
        np.where(r.measured, e.reshape(r.y.shape), np.nan)
        for r, e in zip(error.records, error.errors(theta), strict=True)
    ])  # fmt: skip
    noise = np.maximum(np.sqrt(np.nanmean(e**2, axis=0)), 1e-6) * error.scale
    starts, before, count = error.starts(theta), model.n_past, error.initial
    features = before * len(model.inputs) + model.n_past_y * len(model.outputs)
    plain = _Calibration(
        theta[: error.count], starts, step, True, error.scale, noise, np.zeros(features),
        np.ones(features), np.zeros((1 + features, count)), np.full(count, 0.5),
    )  # fmt: skip
    mean = starts.mean(axis=0) if count else np.zeros(0)
    plain.weights[0] = mean
    if not count or not before:
        return plain
    windows: list[Array] = []
    targets: list[Array] = []
    for record in error.records:
        length, own = before + _AHEAD, -(-_WINDOWS // len(error.records))
        for first in np.unique(np.linspace(0, max(len(record) - length, 0), own).astype(int)):
            part = record[int(first) : int(first) + length]
            if len(part) > before:
                past = part.y[before - model.n_past_y : before]
                windows.append(np.concatenate([part.u[:before].ravel(), past.ravel()]))
                flat = np.full(count, 0.5), np.ones(count)
                targets.append(model.fit_start(plain, part.u, part.measured_y, *flat))
    if len(windows) < 3:
        return plain
    x, z = np.array(windows), np.array(targets)
    center, spread = x.mean(axis=0), x.std(axis=0)
    spread = np.where(spread > 0, spread, 1.0)
    rows = np.column_stack([np.ones(len(x)), (x - center) / spread])
    ridge = np.diag([1e-9, *np.full(features, 0.3)])
    hat = np.linalg.solve(rows.T @ rows + ridge, rows.T)
    weights = hat @ z
    # Errors of windows left out.
    left = (z - rows @ weights) / np.maximum(1.0 - np.einsum("ij,ji->i", rows, hat), 0.1)[:, None]
    deviation = np.maximum(np.sqrt((left**2).mean(axis=0)), 1e-3)
    return replace(plain, center=center, spread=spread, weights=weights, deviation=deviation)


# Simulator in closed loop: sample by sample.


class _SteppedUnit:
    """Instance of an FMU for co-simulation, one communication step a sample."""

    def __init__(self, simulator: Simulator, start: Mapping[str, float]) -> None:
        """start: parameters and initial states."""
        self._simulator, self._start, self._samples = simulator, start, -1
        self._fmpy, self._described = _described(simulator.plant)
        folder = str(simulator.plant.folder)
        self._instance: Any = self._fmpy.instantiate_fmu(folder, self._described, "CoSimulation")
        weakref.finalize(self, self._instance.freeInstance)

    def step(self, u: Array) -> Array:
        """Outputs (ny,) at the end of a sample with inputs u (nu,); at first, those at the start,
        before any sample."""
        of, first = self._simulator, self._samples < 0
        times = np.array([max(self._samples, 0), self._samples + 1]) * of.sampling_time
        held = np.stack([u, u])
        rows = self._fmpy.simulate_fmu(
            str(of.plant.folder),
            validate=False,
            start_time=times[0],
            stop_time=times[1],
            output_interval=of.sampling_time,
            fmi_type="CoSimulation",
            start_values=self._start if first else {},
            input=_held_inputs(self._described, of.inputs, held, times, self._start),
            output=list(of.outputs),
            model_description=self._described,
            fmu_instance=self._instance,
            initialize=first,
            terminate=False,
            set_stop_time=False,
        )
        self._samples += 1
        return np.array([rows[name][-1] for name in of.outputs])


@dataclass(frozen=True)
class SteppedSimulator:
    """Simulator that gets an input sample and answers with the outputs at the end of it.

    Its input sample holds the inputs, then parameters and initial states; those of the first sample
    of a case count, whose answer are the outputs before any input. A Python function is called as
    `step(x, u, params, dt)`, with x None at first, and returns the next x and y. An FMU makes a
    communication step.
    """

    simulator: Simulator

    def simulate(self, past_u: Array, past_y: Array, u: Array) -> Array:
        """Simulate cases (B, H, n) sample by sample."""
        del past_u, past_y
        found: list[Array] = []
        for case in u:
            state, rows = None, list[Array]()
            for sample in case:
                state, y = self.step(state, sample[None])
                rows.append(y[0])
            found.append(np.stack(rows))
        return np.stack(found)

    def initial(self, past_u: Array, past_y: Array, u: Array) -> None:
        """No state before the first sample."""
        del past_u, past_y, u

    def step(self, state: Any, u: Array) -> tuple[Any, Array]:
        """Advance by one sample u (1, n); outputs (1, ny)."""
        of, nu = self.simulator, len(self.simulator.inputs)
        inputs = u[0, :nu]
        if state is None:
            values = u[0, nu:].tolist()
            named = dict(zip((*of.plant.parameters, *of.plant.initial), values, strict=True))
            state = named, _SteppedUnit(of, named) if of.plant.is_unit else None
        parameters, x = state
        if isinstance(x, _SteppedUnit):
            return state, x.step(inputs)[None]
        x, y = _loaded(of.plant.code, of.plant.function)(x, inputs, parameters, of.sampling_time)
        return (parameters, x), np.asarray(y, np.float64).reshape(1, -1)


def stepped(context: Context) -> SteppedSimulator:
    """Make the simulator of a context run sample by sample.

    Raises:
        SimulatorError: for an FMU where fmpy is not installed
    """
    model = build(Config(), context)
    if model.plant.is_unit:
        _described(model.plant)
    return SteppedSimulator(model)


# Check of a simulator before a search.


@dataclass(frozen=True)
class SimulatorProbe:
    """Findings on a simulator, as numbers that leave the sandbox."""

    found: dict[str, float]

    def parameters(self) -> dict[str, float]:
        """`seconds` of a simulation, `failed` share of draws and, where there is time,
        `gradient`, 1 where finite differences are reliable, and for each parameter its share in
        directions that no output shows."""
        return self.found

    def simulate(self, past_u: Array, past_y: Array, u: Array) -> Array:
        """Zeros."""
        return np.zeros((len(u), u.shape[1], past_y.shape[2]))


def probe(trajectories: Sequence[Trajectory], context: Context) -> SimulatorProbe:
    """Call the simulator at random points of its ranges, on the first record.

    Raises:
        SimulatorError: for a simulator that fails, is random, or looks ahead.
    """
    model = build(Config(), context)
    record = trajectories[0]
    error = _SimulationError(model, [record])
    middle = np.full(error.size, 0.5)
    z, start = middle[: error.count], middle[error.count :]
    first = model.run(record.u, z, start)
    tolerance = 1e-6 * np.ptp(first, axis=0)
    # The first call loads libraries.
    begin = time.monotonic()
    again = model.run(record.u, z, start)
    seconds = time.monotonic() - begin
    if (abs(again - first) > tolerance).any():
        raise SimulatorError(
            f"[plant] {model.plant.label} returned other outputs for the same "
            "arguments: use a fixed seed, and keep no state between calls"
        )
    # Differences take up to 30 simulations for each unknown.
    affordable = 30 * error.size * seconds < 0.3 * (context.deadline - begin)
    half = len(record) // 2
    changed = record.u.copy()
    changed[half:] = changed[half:][::-1] + record.u.std(axis=0)
    if (abs(model.run(changed, z, start)[:half] - first[:half]) > tolerance).any():
        raise SimulatorError(
            f"[plant] {model.plant.label} looks ahead: outputs changed before "
            "the input did; output k may use inputs up to k only"
        )
    draws = np.random.default_rng(0).uniform(0.1, 0.9, (_DRAWS, error.size))
    failed = 0
    shares: list[Array] = []
    for draw in draws:
        with contextlib.suppress(SimulatorError):
            model.run(record.u, draw[: error.count], draw[error.count :])
            if len(shares) < 2 and affordable:
                shares.append(_lost(error.jacobian(draw, 1e-3))[: error.count])
            continue
        failed += 1
    found = {"seconds": seconds, "failed": failed / len(draws)}
    if shares:
        names = zip(model.plant.parameters, np.min(shares, axis=0).tolist(), strict=True)
        found |= {f"lost {name}"[:48]: share for name, share in names}
        found["gradient"] = float(error.reliable_step(middle) is not None)
    return SimulatorProbe(found)


def _lost(jacobian: Array) -> Array:
    """Share of each coordinate in the null space of a jacobian (N, n), from 0 to 1."""
    size = np.linalg.norm(jacobian, axis=0)
    _, sizes, ways = np.linalg.svd(jacobian / np.where(size > 0, size, 1.0), full_matrices=False)
    null = ways[sizes <= _NULL * max(sizes[0], 1e-300)]
    return np.where(size > 0, np.linalg.norm(null, axis=0), 1.0)
