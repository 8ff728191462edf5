"""Monitor of a run's model: recursive estimation on new samples, with a test of its validity."""

from __future__ import annotations

import math
import re
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np

from asia._text import suggestion
from asia.control.observer import (
    Filter,
    Method,
    MonitorSample,
    TimeVarying,
    augmented,
    make_observer,
)
from asia.control.observer_c import observed, observer_files
from asia.data.intake.formats import file_format
from asia.data.intake.sheet import Wanted
from asia.data.intake.timestamps import time_column
from asia.data.segment import Segment, SimulatedSegment
from asia.data.trajectory import Array, Signal, Trajectory, real_numbers
from asia.errors import UserError
from asia.export.linear import StepModels, step_models
from asia.export.model import ExportModel
from asia.export.pipeline import measured
from asia.export.target import DOUBLE, ParityRow
from asia.export.targets.c import c_compiler, example_csv
from asia.judge.sandbox.types import Isolation
from asia.ledger.run import Run, open_run
from asia.lowering.evaluation import evaluate
from asia.lowering.program import LoweredModel
from asia.problem.load import read_records

# Memory of parameters in samples.
_MEMORY = 500
# Largest state vector that is printed as C, and samples that the code is compared on.
_LARGEST, _COMPARED = 60, 2_000
_CHANGE = re.compile(r"(gain|offset)\((.+)\)")


class Monitor:
    """Recursive estimation of the states and chosen parameters of a run's model, sample by sample.

    The noise comes from the residuals of the fold models on their held-out samples.
    """

    def __init__(
        self,
        run: Run | Path | str,
        parameters: Sequence[str] = (),
        *,
        method: Method = "ekf",
        false_alarms: float = 1e-4,
        memory: float | None = None,
        spread: float = 0.2,
        model: str | None = None,
        isolation: Isolation | None = None,
    ) -> None:
        """Prepare the observer; the first samples of `update` fill the past window of the model.

        Args:
            run: an opened run or its folder
            parameters: names of physical parameters of a grey-box model, `gain(SIGNAL)` or
                `offset(SIGNAL)` of an input or output, all estimated
            method: extended (`ekf`) or unscented Kalman filter (`ukf`)
            false_alarms: highest number of false alarms a sample
            memory: time in s after which an old sample counts 1/e for the parameters; default: 500
                samples; infinite: nothing is forgotten
            spread: standard deviation of the parameters before the first sample, relative to their
                values; of an offset, to the standard deviation of its signal
            model, isolation: as in `asia.linearize`

        Raises:
            UserError: for an unknown parameter, and a model that has no step
        """
        if not 0.0 < false_alarms < 0.1:
            raise UserError(f"false_alarms is {false_alarms:g}, expected above 0 and below 0.1")
        if method not in ("ekf", "ukf"):
            raise UserError(f"method is '{method}', expected ekf or ukf")
        opened = run if isinstance(run, Run) else open_run(Path(run))
        self.name, self.false_alarms = opened.name, false_alarms
        self.method: Method = method
        physical = [p for p in parameters if _CHANGE.fullmatch(p) is None]
        models = step_models(opened, model, isolation, physical)
        problem = models.problem
        self.use, self.notes, self.problem = models.use, models.notes, problem
        self.inputs, self.outputs = problem.inputs, problem.outputs
        self.sampling_time = problem.sampling_time
        changes = [_change(p, self.inputs, self.outputs) for p in parameters if p not in physical]
        self.records = records = models.evaluator.data.records
        signals = [np.concatenate([getattr(r, side) for r in records]) for side in ("u", "y")]
        held_out = _held_out(models)
        # Nominal values are the last state of the model itself.
        _, window = held_out[0]
        start = evaluate(models.own.initial, [window.past_u, window.past_y, window.u[0]])
        values = start[-1].tolist() if physical else []
        ranges = {} if problem.physics is None else problem.physics.parameters
        chosen = [
            TimeVarying(
                name, value, spread * abs(value),
                *((value / 20.0, 20.0 * value) if ranges[name].min > 0 else ()),
            )
            for name, value in zip(physical, values, strict=True)
        ]  # fmt: skip
        for name, (kind, is_input, channel) in zip(
            [p for p in parameters if p not in physical], changes, strict=True
        ):
            size_of_signal = float(np.nanstd(signals[0 if is_input else 1][:, channel]))
            limits = (0.0, 20.0) if kind == "gain" else ()
            width = spread * (1.0 if kind == "gain" else size_of_signal)
            chosen.append(TimeVarying(name, 1.0 if kind == "gain" else 0.0, width, *limits))
        step = self.sampling_time
        kept = _MEMORY * step if memory is None else memory
        if not kept >= 2.0 * step:
            raise UserError(f"memory is {kept:g} s, expected at least two samples ({2 * step:g} s)")
        observer, self.inside = make_observer(
            models.own, held_out, signals[0].var(axis=0), chosen, changes,
            math.exp(-step / kept), false_alarms,
        )  # fmt: skip
        own = measured(models.own, problem.preprocess, problem.inputs)
        longer = math.prod(own.states[0]) if len(own.states) > len(models.own.states) else 0
        initial = np.r_[np.zeros(longer), observer.initial]
        self.observer = replace(
            observer, low=augmented(own, changes, observer.noise.pole), initial=initial
        )
        self.reset()

    def reset(self) -> None:
        """Forget all samples."""
        self._filter = Filter(self.observer, self.method)
        self._past: list[tuple[Array, Array]] = []
        self._started = False

    @property
    def past(self) -> int:
        """Samples that the model needs before the first result."""
        return max(self.observer.low.n_past_u, self.observer.low.n_past_y)

    def update(self, u: object, y: object) -> MonitorSample | None:
        """Take one sample.

        Args:
            u: inputs (nu,) of the sample, as measured
            y: outputs (ny,), nan where one was not measured

        Returns:
            expected output, NIS and parameters; None while the past window fills

        Raises:
            UserError: for another number of values, and inputs that are not finite
        """
        low = self.observer.low
        row, seen = (np.atleast_1d(real_numbers(x, n)) for x, n in ((u, "u"), (y, "y")))
        if row.shape != (low.nu,) or seen.shape != (low.ny,):
            raise UserError(
                f"a sample has {low.nu} inputs and {low.ny} outputs, got {row.shape} and "
                f"{seen.shape} numbers"
            )
        if not np.isfinite(row).all():
            raise UserError("an input of the sample is missing or infinite: hold its last value")
        if not self._started:
            if len(self._past) < self.past:
                if np.isfinite(seen).all():
                    self._past.append((row, seen))
                else:
                    self._past.clear()  # The past window has no gaps.
                return None
            us = np.array([one for one, _ in self._past]).reshape(-1, low.nu)
            ys = np.array([one for _, one in self._past]).reshape(-1, low.ny)
            self._filter.start(us[len(us) - low.n_past_u :], ys[len(ys) - low.n_past_y :], row)
            self._started = True
        return self._filter.update(row, seen)

    def records_of(self, path: Path) -> tuple[tuple[Trajectory, ...], datetime | None]:
        """Records of a file, as `update` expects them, and the date of its first sample where the
        file has one."""
        problem = self.problem
        plain = replace(problem, preprocess=replace(problem.preprocess, delay={}))
        return read_records(plain, path), _first_date(path, problem.inputs + problem.outputs)

    def on(self, record: Trajectory) -> MonitoredRecord:
        """Monitor a record from its first sample on."""
        self.reset()
        found: list[MonitorSample] = []
        skipped = 0
        for u, y in zip(record.u, record.measured_y, strict=True):
            one = self.update(u, y)
            if one is None:
                skipped += 1
            else:
                found.append(one)
        if not found:
            raise UserError(
                f"record '{record.name}' has {len(record)} samples, expected more than the "
                f"{self.past} of the past window"
            )
        return MonitoredRecord(self, record, skipped, tuple(found))


@dataclass(frozen=True)
class MonitoredRecord:
    """Results of a monitor on a record."""

    monitor: Monitor
    record: Trajectory
    first: int
    """Samples of the past window, without results."""
    samples: tuple[MonitorSample, ...]

    @property
    def nis_inside(self) -> float:
        """Share of the NIS inside their 95 % band."""
        ends = self.band
        each = [ends[0] < s.nis < ends[1] for s in self.samples if s.measured == len(s.y_hat)]
        return float(np.mean(each)) if each else math.nan

    @property
    def band(self) -> tuple[float, float]:
        """95 % band of the NIS."""
        from scipy.special import chdtri

        ny = self.monitor.observer.low.ny
        return float(chdtri(ny, 0.975)), float(chdtri(ny, 0.025))

    @property
    def intervals(self) -> list[tuple[int, int, int | None]]:
        """Samples of the record (since, reported, until) at which the model was not valid; `until`
        is None at the end."""
        found: list[tuple[int, int, int | None]] = []
        for k, one in enumerate(self.samples):
            open_ = bool(found) and found[-1][2] is None
            if one.since is not None and not open_:
                found.append((self.first + one.since, self.first + k, None))
            elif one.since is None and open_:
                found[-1] = (*found[-1][:2], self.first + k)
        return found

    def lines(self, start: datetime | None) -> Iterator[str]:
        """Yield the result in sentences. start: date of the first sample."""

        def when(sample: int) -> str:
            seconds = sample * self.monitor.sampling_time
            if start is None:
                return f"{seconds:g} s"
            moment = start + timedelta(seconds=seconds)
            return f"{moment:%Y-%m-%d %H:%M:%S}"

        yield f"record    {self.record.name}: {len(self.samples)} samples"
        for since, reported, until in self.intervals:
            end = "" if until is None else f", until {when(until)}"
            yield (
                f"alarm     the model is no longer valid since {when(since)} (reported at "
                f"{when(reported)}){end}"
            )
        if not self.intervals:
            yield "valid     no alarm: the model describes the record as it did the training data"
        yield f"NIS       {self.nis_inside:.1%} inside the 95 % band"
        last = self.samples[-1]
        for k, one in enumerate(self.monitor.observer.parameters):
            sure = math.hypot(float(last.deviations[k]), one.floor)
            yield (
                f"parameter {one.name}: {last.parameters[k]:.5g} +- {1.96 * sure:.2g} at the end, "
                f"{one.nominal:.5g} in the run"
            )


def export_observer(monitor: Monitor, folder: Path) -> tuple[list[Path], ParityRow]:
    """Write the observer of a monitor as C99, compared with the monitor on a training record.

    Raises:
        UserError: for an unscented filter, a large state, and code that differs
    """
    observer, low = monitor.observer, monitor.observer.low
    if monitor.method != "ekf":
        raise UserError("the observer in C is an extended Kalman filter: leave --method out")
    if observer.order > _LARGEST:
        raise UserError(
            f"--observer: the model has {observer.order} states with those of the observer, at "
            f"most {_LARGEST} are printed as C: export a smaller model (--model)"
        )
    u, y = (np.concatenate([getattr(r, side) for r in monitor.records]) for side in ("u", "y"))
    input_range, output_range = (
        np.stack([np.nanmin(v, axis=0), np.nanmax(v, axis=0)], axis=1) for v in (u, y)
    )
    model = ExportModel(
        monitor.name, monitor.use, monitor.problem.name, low, monitor.inputs, monitor.outputs,
        monitor.sampling_time, input_range, output_range,
    )  # fmt: skip
    record = max(monitor.records, key=len)
    files = observer_files(model, observer)
    compiler, past = c_compiler(), monitor.past
    row = ParityRow("c observer", None, DOUBLE, None, sum(map(len, files.values())),
                    "no C compiler here: not compared")  # fmt: skip
    u, y = record.u[:_COMPARED], record.measured_y[:_COMPARED]
    before = u[past - low.n_past_u : past], y[past - low.n_past_y : past]
    window = SimulatedSegment(*before, u[past:], y[past:], y_hat=y[past:])
    files["example.csv"] = example_csv(model, window).encode()
    if compiler is not None:
        filter_ = Filter(observer)
        filter_.start(window.past_u, window.past_y, window.u[0])
        each = [filter_.update(*pair) for pair in zip(window.u, window.y, strict=True)]
        expected = np.array(
            [[*s.y_hat, s.nis, s.statistic, *s.parameters, *s.deviations,
              -1 if s.since is None else s.since] for s in each]
        )  # fmt: skip
        with tempfile.TemporaryDirectory(prefix="asia-observer-") as made:
            for name, data in files.items():
                (Path(made) / name).write_bytes(data)
            (found,), seconds = observed(compiler, Path(made), [window], expected.shape[1])
        scale = np.maximum(np.abs(expected).max(axis=0), 1e-300)
        gap = float((np.abs(found - expected) / scale).max())
        row = replace(row, difference=gap, microseconds=1e6 * seconds / len(each), note="")
        if not gap <= DOUBLE:
            raise UserError(
                f"--observer: nothing was written: the code differs from the monitor by {gap:.1e}, "
                f"at most {DOUBLE:.0e} is allowed; export a smaller model (--model)"
            )
    folder.mkdir(parents=True, exist_ok=True)
    for name, data in files.items():
        (folder / name).write_bytes(data)
    return [folder / name for name in files], row


def _change(
    text: str, inputs: Sequence[Signal], outputs: Sequence[Signal]
) -> tuple[str, bool, int]:
    match = _CHANGE.fullmatch(text)
    assert match is not None
    names = [s.name for s in (*inputs, *outputs)]
    if match[2] not in names:
        raise UserError(
            f"parameter '{text}': no signal '{match[2]}'{suggestion(match[2], names)} (there are "
            f"{', '.join(names)})"
        )
    place = names.index(match[2])
    is_input = place < len(inputs)
    return match[1], is_input, place if is_input else place - len(inputs)


def _held_out(models: StepModels) -> list[tuple[LoweredModel, Segment]]:
    """Held-out segments with the model of their fold: neighbouring blocks of a record as one."""
    found: list[tuple[LoweredModel, Segment]] = []
    for low, fold in zip(models.folds, models.evaluator.data.folds, strict=True):
        own: list[Segment] = []
        for block in fold.held_out:
            last = own[-1] if own else None
            if last is not None and (last.record, last.stop) == (block.record, block.start):
                u, y = np.vstack([last.u, block.u]), np.vstack([last.y, block.y])
                own[-1] = replace(last, u=u, y=y)
            else:
                own.append(block)
        found += [(low, one) for one in own]
    return found


def _first_date(path: Path, signals: Sequence[Signal]) -> datetime | None:
    wanted = Wanted(tuple(s.name for s in signals), ())
    (table, *_) = file_format(path).read(path, wanted)
    column = time_column(table, wanted)
    if column is None:
        return None
    cell = table.columns[column].cells[0]
    try:
        return datetime.fromisoformat(str(cell).strip()[:26])
    except ValueError:
        return None
