"""Linear models of a run: its model at operating points, with the fold models beside it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from asia._progress import tracked
from asia._statement import Statement, stated
from asia.data.frequency import FrequencyRecord
from asia.data.statistics import integrating, needs_loop
from asia.data.trajectory import Array, Intersample, Signal, Trajectory
from asia.errors import UserError
from asia.export.pipeline import measured
from asia.judge.evaluation.evaluator import Evaluator
from asia.judge.sandbox.types import Isolation
from asia.ledger.events import Use
from asia.ledger.run import Run, model_to_use, open_run, scored_experiment
from asia.lowering.evaluation import evaluate
from asia.lowering.linear import (
    LinearModel,
    OperatingPoint,
    fold_band,
    joined,
    linearised,
    operating_points,
    settle,
    split,
)
from asia.lowering.program import LoweredModel
from asia.models._numerics.intersample import inputs_of
from asia.problem.load import load_lock
from asia.problem.problem import Problem
from asia.search.run import LOCK, make_evaluator
from asia.search.simulation import (
    band_basis,
    final_members,
    fold_models,
    loading_stored_models,
)

_STARTS = 4
_WALK = 2_000


@dataclass(frozen=True)
class LinearPoint:
    """Linear models at one operating point."""

    name: str
    """The point as it was asked for, such as `u=2.5`."""
    at: OperatingPoint
    rests: bool
    """Whether the states rest there."""
    model: LinearModel
    folds: tuple[LinearModel, ...]
    """Those of the fold models at the same inputs or outputs; fewer where one has no such point."""
    steps: tuple[tuple[LoweredModel, OperatingPoint], ...] = ()
    """The nonlinear models of `model` and `folds` with their operating points."""

    def band(self, name: Literal["gain", "slope_gain"]) -> tuple[Array, Array] | None:
        """90 % band of the static gain or the slope gain, ends (ny, nu), by the fold models; None
        without them."""
        folds = [getattr(one, name) for one in self.folds]
        return fold_band(getattr(self.model, name), folds) if len(folds) > 1 else None

    @property
    def slowest_band(self) -> tuple[float, float] | None:
        """90 % band of the largest real pole by the fold models; None without them."""
        real = [
            one.poles.real[abs(one.poles.imag) < 1e-12].max(initial=-np.inf)
            for one in (self.model, *self.folds)
        ]
        if len(self.folds) < 2 or not np.isfinite(real).all():
            return None
        low, high = fold_band(np.array(real[0]), [np.array(one) for one in real[1:]])
        return float(low), float(high)


def mode_bands(
    model: LinearModel, folds: Sequence[LinearModel]
) -> list[tuple[Array, Array] | None]:
    """90 % band of frequency [Hz] and damping ratio of each mode of the model, ends (2,), by the
    nearest modes of the fold models; None where fewer than two of them have one. That of the
    frequency is computed on a logarithmic scale and ends at half the sampling frequency; that of
    the damping ends at -1 and 1."""
    from scipy.optimize import linear_sum_assignment

    own, step = model.modes(), model.sampling_time
    matched: list[list[Array]] = [[] for _ in own]
    for fold in folds:
        modes = [mode for mode in fold.modes() if mode[1] > 0.0]
        distance = np.array([[abs(a[0] - b[0]) for b in modes] for a in own])
        if distance.size:
            for i, j in zip(*linear_sum_assignment(distance), strict=True):
                matched[i].append(np.array([np.log(modes[j][1]), modes[j][2]]))
    found: list[tuple[Array, Array] | None] = []
    for (_, frequency, damping, _), others in zip(own, matched, strict=True):
        if len(others) < 2 or not frequency > 0.0:
            found.append(None)
            continue
        ends = fold_band(np.array([np.log(frequency), damping]), others)
        most = max(frequency, 0.5 / step) if step else np.inf
        low, high = (
            np.array([min(np.exp(min(f, 700.0)), most), np.clip(z, -1.0, 1.0)]) for f, z in ends
        )
        found.append((low, high))
    return found


@dataclass(frozen=True)
class LinearRun:
    """Linear models of a run."""

    name: str
    use: str
    inputs: tuple[Signal, ...]
    outputs: tuple[Signal, ...]
    points: tuple[LinearPoint, ...]
    notes: tuple[str, ...]
    """Sentences on the choice of the model and on points that do not exist."""
    records: tuple[Trajectory, ...]
    """Training records, on which a reduction is checked and process models are fitted."""
    responses: tuple[FrequencyRecord, ...]
    """Measured frequency responses of the problem."""
    noise: Array
    """Standard deviation (ny,) of the measurement noise."""
    fit: float | None = None
    """Fit of the experiment in percent."""

    @property
    def integrating(self) -> tuple[int, ...]:
        """Numbers of the outputs that integrate, by the training records."""
        return integrating(self.records)

    def is_unstable(self, point: LinearPoint) -> bool:
        """Whether a mode grows, in the model or in the records."""
        if self.integrating:
            return False
        return point.model.is_unstable or needs_loop(self.records)

    def no_rest(self, point: LinearPoint) -> str:
        """Reason that the plant has no resting point and no static gain there; "" where it has."""
        if self.is_unstable(point):
            return "the plant is unstable"
        if self.integrating or point.model.is_integrating:
            return "the plant integrates"
        band = point.slowest_band
        if band is not None and band[1] >= 1.0:
            return (
                f"the interval of the slowest pole, {band[0]:.4g} to {band[1]:.4g}, includes 1: "
                "the plant may integrate"
            )
        return ""

    def gain(
        self, point: LinearPoint, i: int, j: int
    ) -> tuple[Literal["gain", "slope"], Statement]:
        """Static gain from input j to output i, or the slope gain beside an integrator."""
        out, into = self.outputs[i], self.inputs[j]
        unit = f"{out.unit or '1'}/{into.unit or '1'}" if out.unit or into.unit else ""
        reason = self.no_rest(point)
        if self.is_unstable(point):
            return "gain", stated(0.0, None, unit, reason=reason)
        slopes = i in self.integrating or bool(reason and not self.integrating)
        name = "slope_gain" if slopes else "gain"
        band = None if self.integrating and not slopes else point.band(name)
        ends = None if band is None else (float(band[0][i, j]), float(band[1][i, j]))
        unit = f"{out.unit or '1'}/{into.unit or '1'}/s" if slopes else unit
        value = float(getattr(point.model, name)[i, j])
        return "slope" if slopes else "gain", stated(value, ends, unit)


def linearize(
    run: Run | Path | str,
    at: Sequence[str | Array] = (),
    model: str | None = None,
    *,
    isolation: Isolation | None = None,
) -> LinearRun:
    """Linearise the model of a run at operating points.

    Args:
        run: an opened run or its folder
        at: `NAME=VALUE,...` (inputs held, the others at their means in training, or all outputs to
            reach; `u` and `y` name a single one), `start` (first training sample, not at rest), or
            inputs (nu,); default: the mean training inputs
        model: `refit`, or the number of an experiment, whose first fold model is linearised;
            default: the refit, without one the best experiment. The mean of several models has
            the states of all, so it is not linearised.
        isolation: level of the candidate; None for the strongest of this machine

    Raises:
        UserError: for a point that does not exist, and a model that has no step
    """
    opened = run if isinstance(run, Run) else open_run(Path(run))
    found = step_models(opened, model, isolation)
    problem, evaluator, use, notes = found.problem, found.evaluator, found.use, list(found.notes)
    own, *folds = [
        measured(one, problem.preprocess, problem.inputs) for one in (found.own, *found.folds)
    ]
    records = evaluator.data.records
    blocks = evaluator.data.training_blocks[:_STARTS]
    windows = [(block.past_u, block.past_y, block.u) for block in blocks]
    mean = np.concatenate([record.u for record in records]).mean(axis=0)

    def starts(of: LoweredModel) -> list[Array]:
        """States at the beginning of training windows; before them delayed inputs are held."""
        made: list[Array] = []
        for past_u, past_y, u in windows:
            longer = of.n_past_u - len(past_u)
            held = np.concatenate(
                [np.repeat((past_u if len(past_u) else u)[:1], longer, 0), past_u]
            )
            made.append(joined(evaluate(of.initial, [held, past_y, u[0]])))
        return made

    points: list[LinearPoint] = []
    signals = problem.inputs, problem.outputs
    for asked in tracked(at or ("mean",), "operating point"):
        name = asked
        if not isinstance(name, str):
            pairs = zip(problem.inputs, name, strict=True)
            name = ",".join(f"{s.name}={v:g}" for s, v in pairs)
        if name == "start":
            x, u = starts(own)[0], windows[0][2][0]
            y = evaluate(own.output, [*split(own, x), u])[0]
            point = OperatingPoint(x, u, y, float("nan"))
            others = [(one, OperatingPoint(starts(one)[0], u, y, float("nan"))) for one in folds]
            points.append(_point(name, point, own, others, found, rests=False))
            continue
        u, y = (asked, None) if not isinstance(asked, str) else _asked(name, mean, signals)
        there = operating_points(own, starts(own), u, y)
        if not there:
            x = settle(own, starts(own)[0], u, _WALK)
            moved = joined(evaluate(own.update, [*split(own, x), u])) - x
            if y is not None or not np.isfinite(moved).all():
                raise UserError(f"--at {name}: the model has no operating point there")
            notes.append(
                f"{name}: the states do not come to rest there (an integrator or an oscillation): "
                f"the matrices are those of the state after {_WALK} samples"
            )
            value = evaluate(own.output, [*split(own, x), u])[0]
            there = [OperatingPoint(x, u, value, float("nan"))]
        if len(there) > 1:
            outputs = ", ".join(str(np.round(one.y, 6).tolist()) for one in there)
            notes.append(f"{name}: the model rests at {len(there)} points, with outputs {outputs}")
        for place, point in enumerate(there, 1):
            near: list[tuple[LoweredModel, OperatingPoint]] = []
            for one in folds:
                others = operating_points(one, starts(one), point.u, y)
                if others:
                    target = point.y
                    nearest = min(others, key=lambda p: float(np.abs(p.y - target).max()))
                    near.append((one, nearest))
            label = name if len(there) == 1 else f"{name} ({place})"
            rests = bool(np.isfinite(point.residual))
            points.append(_point(label, point, own, near, found, rests=rests))
    noise = band_basis(evaluator, opened.view, opened.store, "ensemble").noise
    return LinearRun(
        opened.name, use, problem.inputs, problem.outputs, tuple(points), tuple(notes),
        tuple(records), problem.responses, noise, opened.view.experiment(found.experiment).fit,
    )  # fmt: skip


@dataclass(frozen=True)
class StepModels:
    """Lowered models of a run: the one that is analysed, and those of the folds."""

    use: str
    """`refit`, or the number of an experiment, whose first fold model is the one."""
    notes: tuple[str, ...]
    """Sentences on the choice."""
    experiment: int
    """Number of the experiment of these models."""
    problem: Problem
    evaluator: Evaluator
    own: LoweredModel
    """For preprocessed signals."""
    folds: tuple[LoweredModel, ...]
    """Fold models of the same candidate."""
    between: tuple[Intersample, ...]
    """Behaviour of each input between samples."""


def step_models(
    run: Run, model: str | None, isolation: Isolation | None, parameters: Sequence[str] = ()
) -> StepModels:
    """Lower the model of a run and its fold models.

    Args:
        model, isolation: as in `linearize`
        parameters: physical parameters that the last state of each model holds

    Raises:
        UserError: for a model that has no step
    """
    use, notes = _chosen(run, model)
    problem = load_lock(run.directory / LOCK)
    evaluator = make_evaluator(problem, run.view, isolation=isolation)
    best = run.view.experiment(int(use)) if use.isdigit() else run.view.best
    assert best is not None
    member = fold_models(best)
    own = member.models[0] if use.isdigit() else final_members(run.view, "refit")[0].models[0]
    with loading_stored_models(run.view):
        models = [run.store.get(name) for name in (own, *member.models)]
        found = evaluator.models.lowered(run.store.text(member.source), models, parameters)
    lowered: list[LoweredModel] = []
    for one in found:
        if isinstance(one, str):
            raise UserError(f"run '{run.name}': the model cannot be lowered to steps: {one}")
        lowered.append(one)
    source = run.store.text(member.source)
    between = inputs_of(source, problem.inputs, evaluator.data.records)
    return StepModels(
        use, tuple(notes), best.number, problem, evaluator, lowered[0], tuple(lowered[1:]), between
    )


def _chosen(run: Run, model: str | None) -> tuple[str, list[str]]:
    """`refit` or the number of an experiment, and why."""
    if model is not None:
        if model.isdigit():
            return str(scored_experiment(run, int(model)).number), []
        if model != "refit":
            raise UserError(
                f"--model is '{model}', expected refit or the number of an experiment: the "
                f"{'mean' if model in get_args(Use) else 'model'} of several models has the "
                "states of all"
            )
        final_members(run.view, "refit")
        return model, []
    named, best = model_to_use(run.view), run.view.best
    if named is None or best is None:
        raise UserError(f"run '{run.name}' has no scored model")
    if run.view.refitted is not None and run.view.refitted.model is not None:
        if named.model == "refit":
            return "refit", []
        return "refit", [
            f"the model to use is the {named.model}, a mean of several models; the linear model is "
            "that of the refit"
        ]
    return str(best.number), [
        f"there is no refit: the linear model is that of fold 1 of #{best.number:02d}"
    ]


def _asked(
    text: str, mean: Array, signals: tuple[Sequence[Signal], Sequence[Signal]]
) -> tuple[Array, Array | None]:
    """Inputs, and outputs where these are asked for."""
    if text == "mean":
        return mean, None
    names = [[one.name for one in side] for side in signals]
    short = {s: side[0] for s, side in zip("uy", names, strict=True) if len(side) == 1}
    values: dict[str, float] = {}
    for part in text.split(","):
        name, _, value = part.rpartition("=")
        name = name.strip() if name.strip() in (*names[0], *names[1]) else short.get(name, "")
        try:
            values[name] = float(value)
        except ValueError:
            values[""] = np.nan
    if set(values) <= set(names[0]) and np.isfinite(list(values.values())).all():
        return np.array([values.get(n, m) for n, m in zip(names[0], mean, strict=True)]), None
    if set(values) == set(names[1]) and np.isfinite(list(values.values())).all():
        return mean, np.array([values[name] for name in names[1]])
    raise UserError(
        f"--at is '{text}', expected start, inputs ({', '.join(names[0])}) or all outputs "
        f"({', '.join(names[1])}), such as {names[0][0]}=2.5"
    )


def _point(
    name: str,
    point: OperatingPoint,
    own: LoweredModel,
    folds: Sequence[tuple[LoweredModel, OperatingPoint]],
    models: StepModels,
    *,
    rests: bool,
) -> LinearPoint:
    model, *each = (
        replace(linearised(one, at, models.problem.sampling_time), inputs=models.between)
        for one, at in ((own, point), *folds)
    )
    return LinearPoint(name, point, rests, model, tuple(each), ((own, point), *folds))
