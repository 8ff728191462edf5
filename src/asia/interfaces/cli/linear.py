"""asia linear: linear models at operating points."""

from __future__ import annotations

import json as jsonlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from asia._progress import tracked
from asia._statement import LEAST_FIT, fit_note, stated
from asia._text import say
from asia.errors import UserError
from asia.interfaces.cli.options import RunOptions, Time, TimeUnit
from asia.interfaces.cli.output import plain

# Greatest number of inputs for which process models are fitted to records.
_MOST_INPUTS = 3
_MOST_CURVES, _MOST_SAMPLES = 6, 5_000
# Share of the response from which a mode has a time constant.
_LEAST_SHARE = 0.01

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from asia.analysis.process import ProcessFit
    from asia.data.frequency import FrequencyRecord
    from asia.data.trajectory import Signal, Trajectory
    from asia.export.linear import LinearPoint, LinearRun
    from asia.ledger.evidence import DrawnCheck
    from asia.lowering.linear import LinearModel, ProcessModel


def linear(
    *,
    run: Annotated[
        str | None,
        typer.Argument(
            metavar="[RUN | FILE]",
            help="Run (default: the newest), a file with a measured frequency response, or a "
            "record, to which process models are fitted.",
        ),
    ] = None,
    inputs: Annotated[
        str | None, typer.Option(help="Input columns of a record; default: by their names.")
    ] = None,
    outputs: Annotated[
        str | None, typer.Option(help="Output columns of a record; default: by their names.")
    ] = None,
    sampling_time: Annotated[
        float | None, typer.Option(help="Sampling time in s of a record without times.")
    ] = None,
    time: Time = None,
    time_unit: TimeUnit = None,
    at: Annotated[
        list[str] | None,
        typer.Option(
            help="Operating point, repeatable: NAME=VALUE of inputs (held, the others at their "
            "means) or outputs (to reach), separated by commas, or start (first training sample); "
            "default: the mean inputs."
        ),
    ] = None,
    reduce: Annotated[
        str | None,
        typer.Option(
            help="Smaller model by balanced truncation: states to keep, or auto (error below 1 %)."
        ),
    ] = None,
    to_tf: Annotated[
        bool,
        typer.Option("--to-tf", help="Print transfer functions and the nearest process models."),
    ] = False,
    continuous_time: Annotated[
        bool, typer.Option("--continuous", help="Print the continuous-time model too.")
    ] = False,
    model: Annotated[
        str | None, typer.Option(help="refit, or the number of an experiment; default: the refit.")
    ] = None,
    response: Annotated[
        list[Path] | None,
        typer.Option(
            help="File with a measured frequency response to compare with, repeatable; default: "
            "those of the problem."
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(help="Folder for linear.png and linear.json; default: linear in the run."),
    ] = None,
    options: RunOptions,
) -> None:
    """Print order, poles, gains and delays of a model at operating points, and draw its Bode plot
    and step response; also smaller, in continuous time or as a transfer function. With a file of a
    frequency response, fit a linear model to it."""
    if run is not None and Path(run).is_file():
        if at or reduce or continuous_time or model or response:
            raise UserError(
                f"{run} is a file: the options of a run do not apply, only --out and --to-tf"
            )
        columns, times = (inputs or "", outputs or ""), (sampling_time, time, time_unit)
        if any(columns) or any(times) or not _is_response(Path(run)):
            _of_record(Path(run), columns, times, out, options)
        else:
            _of_file(Path(run), out, options, to_tf=to_tf)
        return
    if inputs or outputs or sampling_time or time or time_unit:
        raise UserError(
            "--inputs, --outputs, --sampling-time, --time and --time-unit are for a record: name "
            "its file"
        )
    from asia.data.intake.frequency import read_frequency_response
    from asia.export.linear import linearize
    from asia.report.page.sections.evidence import LINEAR_FILE
    from asia.report.pictures.analysis import draw_linear

    directory = options.directory(run)
    given = [read_frequency_response(path) for path in response or ()]
    found = linearize(directory, at or (), model, isolation=options.level)
    compared = _compared(found, given)
    fitted = _fitted(found.records, found.inputs, found.outputs) if to_tf else []
    notes = [*found.notes, *filter(None, [fit_note(found.fit)])]
    facts: dict[str, Any] = {
        "run": found.name,
        "model": found.use,
        "notes": notes,
        "points": [
            _facts(found, one, reduce, to_tf=to_tf, rate=continuous_time) for one in found.points
        ],
        "process_models_of_records": [None if one is None else asdict(one) for one in fitted],
    }
    lines = [f"run {found.name}, model {found.use}", *(f"note      {n}" for n in notes)]
    for point, values, measured in zip(found.points, facts["points"], compared, strict=True):
        values["responses"] = [one.facts for one in measured]
        lines += [*_lines(found, point, values), *(line for one in measured for line in one.lines)]
    lines += _fitted_lines(fitted, found.inputs, found.outputs)
    facts["text"], facts["drawn"] = lines, [asdict(one) for one in _drawn(found)]
    drawn = [(one.name, one.model, one.folds) for one in found.points]
    pictures = [("linear", lambda: draw_linear(drawn, found.inputs, found.outputs))]
    pictures += [one.picture for measured in compared for one in measured]
    _write(facts, pictures, directory / LINEAR_FILE.parent if out is None else out, options)


def _write(
    facts: dict[str, Any],
    pictures: Sequence[tuple[str, Callable[[], Figure]]],
    folder: Path,
    options: RunOptions,
) -> None:
    """Write linear.json and the pictures, and print the lines of `text`."""
    folder.mkdir(parents=True, exist_ok=True)
    text = jsonlib.dumps(plain(facts), allow_nan=False)
    (folder / "linear.json").write_text(text + "\n", "utf-8")
    failed: list[str] = []
    files = [folder / "linear.json"]
    if pictures:
        from asia.report.files import save

        files[:0] = save(pictures, folder, failed)
    if options.json:
        say(text)
    options.print((*facts["text"], *(f"note      {one}" for one in failed)), files)


@dataclass(frozen=True)
class _Compared:
    """Response of a linear model beside a measured one."""

    facts: dict[str, Any]
    lines: tuple[str, ...]
    picture: tuple[str, Callable[[], Figure]]


def _compared(run: LinearRun, given: Sequence[FrequencyRecord]) -> list[list[_Compared]]:
    """Compare the model at each operating point with each measured response.

    Args:
        given: responses; those of the problem where there are none
    """
    from asia.models.frequency_response import fit_frequency_response, sampled_response
    from asia.report.pictures.analysis import draw_frequency_response

    found: list[list[_Compared]] = [[] for _ in run.points]
    step = run.points[0].model.sampling_time
    own = [one.of_channels(run.inputs, run.outputs, step) for one in given] or run.responses
    for number, record in enumerate(own, 1):
        if not record.sampling_time:
            record = sampled_response(fit_frequency_response(record), step)
        measured, known = record.response, record.variance is not None
        deviation = None if record.variance is None else np.sqrt(record.variance)
        for place, (point, results) in enumerate(zip(run.points, found, strict=True), 1):
            apart = np.abs(measured - point.model.response(record.frequency))
            size = np.sqrt((np.abs(measured) ** 2).mean(axis=0))
            error = np.sqrt((apart**2).mean(axis=0)) / np.maximum(size, 1e-300)
            times = None if deviation is None else np.sqrt(((apart / deviation) ** 2).mean(axis=0))
            worst = record.frequency[apart.argmax(axis=0)]
            lines = [
                f"measured  {out.name} by {into.name}: relative error {error[i, j]:.2%} of "
                f"response {record.name}, largest at {worst[i, j]:.4g} Hz"
                + ("" if times is None else f"; {times[i, j]:.3g} times its standard deviation")
                for i, out in enumerate(run.outputs)
                for j, into in enumerate(run.inputs)
            ]
            if not given:
                lines.append(f"note      linear models of the search know {record.name}")
            facts = {
                "response": record.name, "relative_error": error, "largest_error_hz": worst,
                "errors_in_standard_deviations": times if known else None,
            }  # fmt: skip
            curves = [(one, 0.0) for one in (point.model, *point.folds)]
            draw = partial(
                draw_frequency_response, record.frequency, measured, deviation, curves,
                run.inputs, run.outputs,
            )  # fmt: skip
            name = f"linear_response{number}" + (f"_at{place}" if len(run.points) > 1 else "")
            results.append(_Compared(facts, tuple(lines), (name, draw)))
    return found


def _is_response(path: Path) -> bool:
    """Whether a file has a frequency response: by its first column, or by its kind."""
    from asia.data.intake.conversion import survey
    from asia.data.intake.sheet import Wanted, split_unit

    if path.suffix.lower() in (".npz", ".mat"):
        return True
    names = {split_unit(name)[0].lower() for name in survey(path, Wanted((), ())).names}
    return bool(names & {"frequency", "freq", "omega", "w", "f"})


def _of_record(
    path: Path,
    columns: tuple[str, str],
    times: tuple[float | None, str | None, str | None],
    out: Path | None,
    options: RunOptions,
) -> None:
    """Fit process models to a record.

    Args:
        times: sampling time in s, column of the time stamps, and their unit
    """
    from asia.data.bad_samples import find_bad_samples
    from asia.data.intake.conversion import split_names, survey, take_in
    from asia.data.intake.sheet import Wanted
    from asia.data.trajectory import Signal

    sampling_time, time, unit = times
    known = survey(path, Wanted((), (), time, unit))
    inputs, outputs = (split_names(text, known.names) for text in columns)
    outputs = outputs or [name for name in known.outputs if name not in inputs]
    inputs = inputs or [name for name in known.inputs if name not in outputs]
    if not inputs or not outputs:
        raise UserError(f"{path}: name the columns by --inputs and --outputs")
    if len(inputs) > _MOST_INPUTS:
        raise UserError(f"{path}: {len(inputs)} inputs, expected at most {_MOST_INPUTS}")
    wanted = Wanted(tuple(inputs), tuple(outputs), time, unit)
    found = take_in([path], wanted, "train", sampling_time, 20)
    signals = [
        tuple(Signal(name, found.units.get(name, "")) for name in side)
        for side in (found.inputs, found.outputs)
    ]
    bad = find_bad_samples(found.records, found.inputs, found.outputs)
    fitted = _fitted(found.records, *signals)
    step = found.records[0].sampling_time
    rows = sum(map(len, found.records))
    lines = [
        f"record {path.name}: {_counted(rows, 'sample')} of {step:g} s, inputs "
        f"{', '.join(found.inputs)}, outputs {', '.join(found.outputs)}",
        *(f"read      {one}" for one in found.readings),
        *(f"note      {note}" for note in found.notes),
        *(f"doubt     {one}" for one in bad), *_fitted_lines(fitted, *signals),
    ]  # fmt: skip
    facts: dict[str, Any] = {
        "file": str(path), "sampling_time": step, "inputs": found.inputs, "outputs": found.outputs,
        "process_models_of_records": [None if one is None else asdict(one) for one in fitted],
        "text": lines,
    }  # fmt: skip
    _write(facts, [], out or Path("linear"), options)


def _of_file(path: Path, out: Path | None, options: RunOptions, *, to_tf: bool) -> None:
    """Fit a linear model to a measured frequency response."""
    from asia.data.intake.frequency import read_frequency_response
    from asia.models.frequency_response import fit_frequency_response
    from asia.report.pictures.analysis import draw_frequency_response

    record = read_frequency_response(path)
    found = fit_frequency_response(record)
    model, step = found.model, record.sampling_time
    known = record.variance is not None
    frequency, (ny, nu) = record.frequency, model.d.shape
    kind = f"sampling time {step:g} s" if step else "continuous time"
    folds = [fold for fold, _ in found.folds]
    low, high = float(frequency.min()), float(frequency.max())
    outside = f"measured from {low:.4g} to {high:.4g} Hz alone"
    dynamics = _dynamics(model, folds, outside if low > 0.0 else "")
    for one in dynamics["poles"]:
        if not low <= one["frequency_hz"] <= high and not one["withheld"]:
            one["time_s"], one["withheld"] = None, outside
    lines = [
        f"frequency response {record.name}: {_counted(len(frequency), 'frequency')} from "
        f"{low:.4g} to {high:.4g} Hz, {_counted(ny, 'output')}, {_counted(nu, 'input')}",
        f"order     {model.order}, {kind}",
        f"delay     {found.delay:.4g} s ({found.delay_band[0]:.4g} to {found.delay_band[1]:.4g} s)",
        *_pole_lines(dynamics["poles"], step),
    ]
    for i, one in enumerate(record.outputs):
        for j, into in enumerate(record.inputs):
            gains = [fold.gain[i, j] for fold in folds] + [model.gain[i, j]]
            reason = "" if low == 0.0 else f"no static gain, as it is {outside}"
            gain = stated(float(model.gain[i, j]), (min(gains), max(gains)), reason=reason)
            lines.append(f"gain      {one.name} by {into.name}: {gain}")
    if to_tf:
        names = [[one.name for one in side] for side in (record.outputs, record.inputs)]
        lines += _transfer_lines(model, names[0], names[1], "z" if step else "s")
    if known:
        lines.append(
            f"fit       the residual is {found.error:.3g} times its standard deviation, "
            f"{found.held_out:.3g} times at held-out frequencies"
        )
        if found.held_out > 1.3:
            lines.append("note      more than noise is left: the system is not linear, or larger")
    else:
        lines.append(
            f"fit       relative error {found.error:.2%}, {found.held_out:.2%} at held-out "
            "frequencies"
        )
    facts: dict[str, Any] = {
        "file": str(path), "order": model.order, "sampling_time": step, "delay": found.delay,
        "delay_band": found.delay_band, "A": model.a, "B": model.b, "C": model.c,
        "D": model.d, "error": found.error, "held_out_error": found.held_out,
        "orders": found.tried, "text": lines, **dynamics,
    }  # fmt: skip
    deviation = None if record.variance is None else np.sqrt(record.variance)
    curves = [(found.model, found.delay), *found.folds]
    draw = partial(
        draw_frequency_response, frequency, record.response, deviation, curves,
        record.inputs, record.outputs,
    )  # fmt: skip
    _write(facts, [("linear", draw)], out or Path("linear"), options)


def _drawn(run: LinearRun) -> list[DrawnCheck]:
    """Bode plot and step response of all points, for the report and the live page."""
    from asia.ledger.evidence import DrawnCheck, DrawnCurve
    from asia.lowering.linear import corner_frequencies, settling_samples

    gains: list[DrawnCurve] = []
    phases: list[DrawnCurve] = []
    steps: list[DrawnCurve] = []
    samples = min(max(settling_samples(one.model) for one in run.points), _MOST_SAMPLES)
    for point in run.points:
        frequencies = corner_frequencies(point.model, 120)
        response = point.model.response(frequencies)
        size, angle = np.abs(response), np.degrees(np.unwrap(np.angle(response), axis=0))
        reaction = point.model.step_response(samples)
        time = point.model.sampling_time * np.arange(samples)
        every = max(samples // 120, 1)
        for i, out in enumerate(run.outputs):
            for j, into in enumerate(run.inputs):
                name = f"{out.name} by {into.name}, {point.name}"
                gains.append(DrawnCurve(name, frequencies.tolist(), size[:, i, j].tolist()))
                phases.append(DrawnCurve(name, frequencies.tolist(), angle[:, i, j].tolist()))
                shown = reaction[::every, i, j].tolist()
                steps.append(DrawnCurve(name, time[::every].tolist(), shown))
    panels = (
        ("frequency response", ("frequency [Hz]", "gain"), gains),
        ("phase", ("frequency [Hz]", "phase [degrees]"), phases),
        ("step response", ("time [s]", "output for a unit step"), steps),
    )
    return [DrawnCheck(name, axes, tuple(each[:_MOST_CURVES])) for name, axes, each in panels]


def _facts(
    run: LinearRun, point: LinearPoint, reduce: str | None, *, to_tf: bool, rate: bool
) -> dict[str, Any]:
    """Everything that is printed of a point, and the matrices."""
    from asia.data.trajectory import deviations
    from asia.lowering.linear import (
        continuous,
        largest_gain,
        process_model,
        reduced,
    )
    from asia.lowering.linear import settling_samples as settling

    model, folds = point.model, point.folds
    reason, unstable = run.no_rest(point), run.is_unstable(point)
    gains = [
        [run.gain(point, i, j) for j in range(len(run.inputs))] for i in range(len(run.outputs))
    ]
    found: dict[str, Any] = {
        "at": point.name, "u": model.u0, "y": None if reason else model.y0,
        "at_rest": point.rests and not reason, "no_rest": reason or None,
        "order": model.order, "sampling_time": model.sampling_time,
        "A": model.a, "B": model.b, "C": model.c, "D": model.d,
        **_dynamics(model, point.folds, reason), **_delays(run, model),
        "fold_poles": [[{"real": p.real, "imag": p.imag} for p in one.poles] for one in folds],
        "gains": [
            [{"kind": kind, "text": str(one), **asdict(one)} for kind, one in row] for row in gains
        ],
        "gain": [[one.value if kind == "gain" else None for kind, one in row] for row in gains],
        "fold_gains": [] if reason else [one.gain for one in folds],
    }  # fmt: skip
    if reduce is not None:
        if reduce != "auto" and not reduce.isdigit():
            raise UserError(f"--reduce is '{reduce}', expected auto or a number of states")
        # Signals of several units count by their deviations.
        u, y = (np.concatenate([getattr(r, side) for r in run.records]) for side in ("u", "y"))
        units = deviations(u), deviations(y)
        whole = model.scaled(*units)
        small = reduced(whole, None if reduce == "auto" else int(reduce))
        made = small.model.scaled(*(1.0 / one for one in units))
        inputs = max(run.records, key=len).u
        apart = (model.simulate(inputs) - made.simulate(inputs)) / units[1]
        size = largest_gain(whole)
        found["reduced"] = {
            "order": made.order, "bound": small.bound,
            "relative_bound": small.bound / size if np.isfinite(size) and size > 0 else None,
            **_dynamics(made, (), reason), "singular_values": small.singular_values,
            "difference_on_record": float(np.sqrt((apart**2).mean())),
            "A": made.a, "B": made.b, "C": made.c, "D": made.d,
        }  # fmt: skip
    if to_tf:
        samples = settling(model)
        steps, t = model.step_response(samples), model.sampling_time * np.arange(samples)
        found["numerators"], found["denominator"] = model.numerator()
        found["process_models"] = [
            [None if unstable or one.value is None else
             _process(t, steps[:, i, j], process_model, integrator=kind == "slope")
             for j, (kind, one) in enumerate(row)] for i, row in enumerate(gains)
        ]  # fmt: skip
    if rate:
        try:
            same, dead = continuous(model)
            found["continuous"] = {
                "A": same.a, "B": same.b, "C": same.c, "D": same.d,
                **_dynamics(same, (), reason), "dead_time_samples": dead,
            }  # fmt: skip
        except UserError as error:
            found["continuous"] = {"none": str(error)}
    return found


def _delays(run: LinearRun, model: LinearModel) -> dict[str, Any]:
    """Samples before each input acts on each output, by the training records, with 95 % intervals;
    those of the model, without, where the records do not tell, and -1 without an effect."""
    from asia.data.statistics import delays

    found = delays(run.records)
    return {
        "delay_samples": [
            [
                int(model.delay[i, j]) if one is None or one.lag is None else one.lag
                for j, one in enumerate(row)
            ]
            for i, row in enumerate(found)
        ],
        "delay_intervals": [[None if one is None else one.interval for one in r] for r in found],
    }


def _dynamics(
    model: LinearModel, folds: Sequence[LinearModel] = (), no_rest: str = ""
) -> dict[str, Any]:
    """Poles, zeros and static gain: what the records carry of each."""
    from asia.export.linear import mode_bands

    poles: list[dict[str, Any]] = []
    shares = model.mode_shares()
    for (p, f, z, t), band, share in zip(
        model.modes(), mode_bands(model, folds), shares, strict=True
    ):
        ends = None if band is None else (float(band[0][0]), float(band[1][0]))
        rate = stated(f, ends, "Hz", positive=True, reason=_hidden(share))
        poles.append({
            "real": p.real, "imag": p.imag, "frequency_hz": f, "damping": z,
            "time_s": None if rate.value is None else t, "frequency_band": rate.interval,
            "damping_band": None if band is None else [float(band[0][1]), float(band[1][1])],
            "withheld": rate.reason or None, "share": share, "integrates": model.integrates(p),
        })  # fmt: skip
    return {
        "poles": poles, "zeros": [{"real": z.real, "imag": z.imag} for z in model.zeros],
        "gain": None if no_rest else model.gain,
    }  # fmt: skip


def _hidden(share: float) -> str:
    """Reason that a mode has no time constant; "" where it has."""
    return (
        "" if not share < _LEAST_SHARE else f"{share:.1%} of the response, a zero nearly cancels it"
    )


def _fitted(
    records: Sequence[Trajectory], inputs: Sequence[Signal], outputs: Sequence[Signal]
) -> list[ProcessFit | None]:
    """Process models of records, one for each output; None where there is none."""
    from asia.analysis.process import fit_process

    found: list[ProcessFit | None] = []
    for i in tracked(range(len(outputs)), "output"):
        try:
            few = len(inputs) <= _MOST_INPUTS
            found.append(fit_process(records, i, inputs=inputs) if few else None)
        except (UserError, ValueError):
            found.append(None)
    return found


def _fitted_lines(
    fitted: Sequence[ProcessFit | None], inputs: Sequence[Signal], outputs: Sequence[Signal]
) -> Iterator[str]:
    """Yield the process models of the records with their intervals."""
    from asia.data.trajectory import INTERSAMPLE

    if fitted:
        yield ""
        yield "process models fitted to the records, with 95 % intervals"
    for out, one in zip(outputs, fitted, strict=False):
        if one is None:
            yield f"process   {out.name}: none (no change, or more than {_MOST_INPUTS} inputs)"
            continue
        for j, (into, model, values, reason) in enumerate(
            zip(inputs, one.models, one.parameters, one.withheld, strict=True)
        ):
            if model is None:
                yield f"process   {out.name} by {into.name}: none, as {reason}"
                continue
            kind = one.between[j]
            between = "" if kind == "zero" else f", input {INTERSAMPLE[kind]} between samples"
            yield f"process   {out.name} by {into.name}: {model}, fit {model.fit:.1f} %{between}"
            gain = f"{out.unit or '1'}/{into.unit or '1'}{'/s' if model.integrator else ''}"
            for k, p in enumerate(values):
                yield f"            {p.name} {one.statement(j, k, gain)}"


def _process(t: Any, y: Any, fit: Callable[..., ProcessModel], *, integrator: bool) -> Any:
    try:
        one = fit(t, y, integrator=integrator)
    except UserError:
        return None
    return {**asdict(one), "text": str(one)} if one.fit >= LEAST_FIT else None


def _lines(run: LinearRun, point: LinearPoint, facts: dict[str, Any]) -> Iterator[str]:
    """Yield what is printed of a point."""
    from asia.lowering.linear import continuous

    model, step = point.model, point.model.sampling_time

    def values(signals: Sequence[Signal], numbers: Any) -> str:
        pairs = zip(signals, numbers, strict=True)
        return ", ".join(f"{s.name} {v:.5g} {s.unit}".rstrip() for s, v in pairs)

    names = [[one.name for one in side] for side in (run.inputs, run.outputs)]
    at = f"at {point.name}: {values(run.inputs, model.u0)}"
    yield ""
    if facts["no_rest"]:
        yield f"{at}; no resting point: {facts['no_rest']}"
    else:
        rest = "" if facts["at_rest"] else " (not at rest)"
        yield f"{at}; {values(run.outputs, model.y0)}{rest}"
    yield f"order     {model.order}, sampling time {step:g} s"
    yield from _pole_lines(facts["poles"], step, point.slowest_band)
    shown = [f"{z.real:.5g}" + (f"{z.imag:+.5g}i" if abs(z.imag) > 1e-12 else "")
             for z in model.zeros]  # fmt: skip
    if shown:
        yield f"zeros     {', '.join(shown)}"
    for i, out in enumerate(run.outputs):
        for j, into in enumerate(run.inputs):
            dead, sure = int(facts["delay_samples"][i][j]), facts["delay_intervals"][i][j]
            by = "" if sure is None or sure[0] == sure[1] else f"; {sure[0]} to {sure[1]} samples"
            late = f"delay {_counted(dead, 'sample')} ({dead * step:g} s{by})"
            late = "no effect" if dead < 0 else late
            gain = facts["gains"][i][j]
            yield f"{gain['kind']:<10}{out.name} by {into.name}: {gain['text']}, {late}"
            if "process_models" in facts and facts["process_models"][i][j]:
                one = facts["process_models"][i][j]
                yield f"process   {out.name} by {into.name}: {one['text']}, fit {one['fit']:.1f} %"
    if "denominator" in facts:
        yield from _transfer_lines(model, names[1], names[0], "z")
        try:
            same, dead = continuous(model)
            yield from _transfer_lines(same, names[1], names[0], "s", dead * step)
        except UserError as error:
            yield f"H(s)      none: {error}"
    if "reduced" in facts:
        one = facts["reduced"]
        share = one["relative_bound"]
        part = "" if share is None else f", {100 * share:.2g} % of its largest value"
        yield (
            f"reduced   to {_counted(one['order'], 'state')}: the frequency response differs by at "
            f"most {one['bound']:.3g} standard deviations of outputs for one of inputs{part}; on "
            f"the longest training record the outputs differ by {one['difference_on_record']:.2g}"
        )
        yield from _model_lines(run, one, step)
    if "none" in facts.get("continuous", ()):
        yield f"note      {facts['continuous']['none']}"
    elif "continuous" in facts:
        one = facts["continuous"]
        dead = one["dead_time_samples"]
        late = f" after a dead time of {dead * step:g} s" if dead else ""
        yield f"continuous order {len(one['A'])}{late}; the matrices are in linear.json"
        yield from _model_lines(run, one, 0.0)


def _model_lines(run: LinearRun, facts: dict[str, Any], step: float) -> Iterator[str]:
    """Yield poles and gains of a model that was made from another, indented."""
    yield from (f"  {line}" for line in _pole_lines(facts["poles"], step))
    if facts["gain"] is None:
        return
    for i, out in enumerate(run.outputs):
        for j, into in enumerate(run.inputs):
            gain = f"{facts['gain'][i, j]:.5g}{_gain_unit(out, into)}"
            yield f"  gain      {out.name} by {into.name}: {gain}"


def _gain_unit(out: Signal, into: Signal) -> str:
    return f" {out.unit or '1'}/{into.unit or '1'}" if out.unit or into.unit else ""


def _pole_lines(
    poles: Sequence[dict[str, Any]], step: float, slowest: tuple[float, float] | None = None
) -> Iterator[str]:
    """Yield a line for each mode, with the bands of frequency and damping where they are known.

    Args:
        poles: as `_dynamics` gives them
        step: sampling time in s; 0 for continuous time
        slowest: band of the largest real pole
    """
    edge, nyquist = (1.0, 0.5 / step) if step else (0.0, np.inf)
    memory, largest = 0, max((one["real"] for one in poles if one["imag"] <= 1e-12), default=edge)
    for one in poles:
        pole = complex(one["real"], one["imag"])
        if step and pole == 0:
            memory += 1 + (pole.imag > 1e-12)
            continue
        # Rounding parts a double pole by about 1e-8.
        end = " twice" if pole.imag <= 1e-6 * abs(pole) else f" +- {pole.imag:.6g}i"
        text = f"{pole.real:.6g}" + (end if pole.imag > 1e-12 else "")
        text = f"pole      {text:<24}"
        if np.isnan(one["frequency_hz"]):
            yield f"{text} no continuous counterpart"
            continue
        if one["integrates"]:
            yield f"{text} integrator"
            continue
        near = slowest is not None and slowest[1] >= 1.0 and pole.real >= largest
        if abs(pole) > 1.0 if edge else pole.real > 0.0:
            kind = "unstable"
        elif near and pole.imag <= 1e-12:
            kind = "no time constant: its interval includes 1"
        elif one["withheld"]:
            yield f"{text} no time constant: {one['withheld']}"
            continue
        else:
            kind = f"time constant {one['time_s']:.4g} s"
        sure = ["", ""]
        for k, band in enumerate((one["frequency_band"], one["damping_band"])):
            if band is not None:
                sure[k] = f" ({band[0]:.4g} to {band[1]:.4g})"
        rate = f"{one['frequency_hz']:.4g} Hz{sure[0]}"
        if one["frequency_hz"] > nyquist:
            rate = f"above {nyquist:.4g} Hz, half the sampling frequency"
        damping = f"{one['damping']:.3g}{sure[1] if pole.imag > 1e-12 else ''}"
        yield f"{text} {rate}, damping {damping}, {kind}"
    if memory:
        text = "0" if memory == 1 else f"0, {memory} times"
        yield f"pole      {text:<24} memory of {_counted(memory, 'sample')}, such as a dead time"


def _counted(count: int, noun: str) -> str:
    plural = f"{noun[:-1]}ies" if noun.endswith("y") else f"{noun}s"
    return f"{count} {noun if count == 1 else plural}"


def _transfer_lines(
    model: LinearModel,
    outputs: Sequence[str],
    inputs: Sequence[str],
    variable: str,
    delay: float = 0.0,
) -> Iterator[str]:
    """Yield transfer functions from all inputs to all outputs, after a delay in s."""
    numerators, below = model.numerator()
    dead = f" exp(-{delay:.4g} s)" if delay else ""
    for i, out in enumerate(outputs):
        for j, into in enumerate(inputs):
            ratio = f"{_polynomial(numerators[i][j], variable)} / {_polynomial(below, variable)}"
            yield f"H({variable})      {out} by {into}: {ratio}{dead}"


def _polynomial(coefficients: Any, variable: str) -> str:
    """Polynomial in a variable, such as (0.5 z + 1)."""
    most = len(coefficients) - 1
    terms = [
        ("" if value == 1.0 and most > k else f"{value:.5g} ").strip()
        + ("" if most == k else f" {variable}" + (f"^{most - k}" if most - k > 1 else ""))
        for k, value in enumerate(coefficients)
        if value
    ]
    return f"({' + '.join(term.strip() for term in terms) or '0'})".replace("+ -", "- ")
