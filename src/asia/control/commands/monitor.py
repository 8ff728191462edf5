"""asia monitor: is the model of a run still valid on a recorded file?"""

from __future__ import annotations

import json as jsonlib
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
import typer

from asia._text import say
from asia.errors import UserError
from asia.interfaces.cli.options import RunOptions

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from asia.control.monitor import MonitoredRecord


def monitor(
    *,
    words: Annotated[
        list[str],
        typer.Argument(metavar="[RUN] FILE", help="Run (default: the newest) and recorded file."),
    ],
    parameter: Annotated[
        list[str] | None,
        typer.Option(
            help="Parameter to estimate, repeatable: of the equations, gain(SIGNAL), "
            "offset(SIGNAL); default: the states alone."
        ),
    ] = None,
    method: Annotated[
        Literal["ekf", "ukf"], typer.Option(help="Extended or unscented Kalman filter.")
    ] = "ekf",
    false_alarms: Annotated[float, typer.Option(help="Highest number a sample.")] = 1e-4,
    memory: Annotated[
        float | None, typer.Option(help="Memory for the parameters in s; default: 500 samples.")
    ] = None,
    model: Annotated[
        str | None, typer.Option(help="refit, or the number of an experiment; default: the refit.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder for the picture; default: monitor in the run.")
    ] = None,
    options: RunOptions,
) -> None:
    """Say since when the model of a run no longer describes the system, from a recorded file.

    An observer estimates the states, and the parameters that are named, sample by sample. The exit
    code is 1 where the model is not valid at the end of a record.
    """
    from asia.control.monitor import Monitor
    from asia.report.files import save

    if len(words) > 2:
        raise UserError(f"expected a run and a file, got {len(words)} words: {' '.join(words)}")
    path = Path(words[-1])
    if not path.is_file():
        raise UserError(f"{path}: no such file: name a recorded file after the run")
    directory = options.directory(words[0] if len(words) == 2 else None)
    found = Monitor(
        directory, parameter or (), method=method, false_alarms=false_alarms, memory=memory,
        model=model, isolation=options.level,
    )  # fmt: skip
    records, date = found.records_of(path)
    rate = f"at most {false_alarms:g} false alarms a sample"
    notes = (f"note      {note}" for note in found.notes)
    options.print((f"run {found.name}, model {found.use}: {rate}", *notes))
    valid = True
    for k, record in enumerate(records):
        result = found.on(record)
        text = list(result.lines(date if k == 0 else None))
        failed: list[str] = []
        name = "monitor" if len(records) == 1 else f"monitor-{k + 1}"
        folder = out or directory / "monitor"
        files = save([(name, lambda result=result: _picture(result))], folder, failed)
        if options.json:
            last = result.samples[-1]
            facts = {
                "record": record.name, "samples": len(result.samples),
                "valid": last.valid, "alarms": result.intervals,
                "nis_inside": result.nis_inside, "threshold": found.observer.threshold,
                "parameters": {p.name: value for p, value in
                               zip(found.observer.parameters, last.parameters.tolist(),
                                   strict=True)},
                "files": [str(file) for file in files],
            }  # fmt: skip
            say(jsonlib.dumps(facts, allow_nan=False))
        options.print((*text, *(f"note      {one}" for one in failed)), files)
        valid &= result.samples[-1].valid
    if not valid:
        raise typer.Exit(1)


def _picture(found: MonitoredRecord) -> Figure:
    from asia.control.drawing import draw_monitor

    owner, step, first = found.monitor, found.monitor.sampling_time, found.first
    samples = found.samples
    y_hat = np.stack([s.y_hat for s in samples])
    measured = found.record.measured_y[first:]
    estimates = np.stack([s.parameters for s in samples])
    widths = np.stack([s.deviations for s in samples])
    end = (first + len(samples)) * step
    return draw_monitor(
        step * np.arange(first, first + len(samples), dtype=np.float64),
        [(one, measured[:, k], y_hat[:, k]) for k, one in enumerate(owner.outputs)],
        (np.array([s.nis for s in samples]), *found.band),
        (np.array([s.statistic for s in samples]), owner.observer.threshold),
        [(p.name, p.nominal, estimates[:, k], 1.96 * np.hypot(widths[:, k], p.floor))
         for k, p in enumerate(owner.observer.parameters)],
        [(since * step, end if until is None else until * step)
         for since, _, until in found.intervals],
    )  # fmt: skip
