"""asia certify: statements on a model with a proof."""

from __future__ import annotations

import json as jsonlib
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from asia._text import say
from asia.data.trajectory import Signal
from asia.errors import UserError
from asia.interfaces.cli.options import RunName, RunOptions


def certify(
    *,
    run: RunName = None,
    u: Annotated[
        list[str] | None,
        typer.Option(
            "--u",
            help="Input limits, 0..10 or name=0..10, repeatable; default: the records'. With "
            "--loop the inputs are r, load and noise.",
        ),
    ] = None,
    y: Annotated[
        list[str] | None,
        typer.Option(
            "--y",
            help="Output limits to prove, 0..10 or name=0..10, repeatable; default: none.",
        ),
    ] = None,
    horizon: Annotated[int, typer.Option(min=1, help="Samples of the tube.")] = 50,
    model: Annotated[
        str | None,
        typer.Option(
            help="refit, ensemble, stack, or the number of an experiment, whose file is "
            "certificate-N.json; default: the model to use."
        ),
    ] = None,
    loop: Annotated[
        bool,
        typer.Option(
            "--loop",
            help="The closed loop with the controller of asia control and each model that judged "
            "it, in place of the model.",
        ),
    ] = False,
    check: Annotated[
        Path | None, typer.Option(help="Prove the statements of this certificate again.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="File; default: certificate.json in the run.")
    ] = None,
    options: RunOptions,
) -> None:
    """Prove statements on a model, or on the closed loop with a controller: stability and gains
    where they are linear, bounds of the outputs. Without a proof there is no certificate."""
    from asia.control.certificate_check import check_certificate

    if check is not None:
        proven = check_certificate(check)
        for line in [jsonlib.dumps(proven)] if options.json else [f"proven    {s}" for s in proven]:
            say(line)
        return
    from asia.control.certificate import certify as find
    from asia.control.report import CERTIFICATE_FILE
    from asia.export.pipeline import lowered_run
    from asia.ledger.run import open_run
    from asia.lowering.evaluation import evaluate
    from asia.lowering.linear import joined

    if loop:
        content, path = _certified_loop(
            options.directory(run), u or (), y or (), horizon, model, options.level
        )
        _write(content, path if out is None else out, json=options.json)
        _exit(content, limits=bool(y))
        return
    opened = open_run(options.directory(run))
    ready = lowered_run(opened, model, options.level)
    subject, window = ready.model, ready.windows[0]
    limits = np.array(subject.input_range, np.float64)
    _set_limits("--u", u or (), subject.inputs, limits)
    within = np.tile([-np.inf, np.inf], (len(subject.outputs), 1))
    _set_limits("--y", y or (), subject.outputs, within)
    first = np.clip(window.u[0], limits[:, 0], limits[:, 1])
    start = joined(evaluate(subject.lowered.initial, [window.past_u, window.past_y, first]))
    facts = _facts(
        subject.name, subject.use, subject.inputs, subject.outputs, limits, subject.sampling_time,
        "start: the state before the first training window; the box holds it",
        "the statements are about the model, not about the system: model errors and noise are not "
        "part of them",
    )  # fmt: skip
    content = find(subject.lowered, limits, start, horizon, facts, within if y else None)
    # Each experiment has a file of its own, so that their gains are compared.
    own = f"certificate-{int(model)}.json" if model and model.isdecimal() else CERTIFICATE_FILE
    _write(content, opened.directory / own if out is None else out, json=options.json)
    _exit(content, limits=bool(y))


def _facts(
    run: str, model: str, inputs: Sequence[Signal], outputs: Sequence[Signal], limits: np.ndarray,
    sampling_time: float, *assumptions: str,
) -> dict[str, Any]:  # fmt: skip
    """Facts on the model of a certificate; limits of the inputs (nu, 2)."""
    spans = ", ".join(
        f"{s.label} from {low:g} to {high:g}"
        for s, (low, high) in zip(inputs, limits.tolist(), strict=True)
    )
    return {
        "run": run,
        "model": model,
        "inputs": [(one.name, one.unit) for one in inputs],
        "outputs": [(one.name, one.unit) for one in outputs],
        "assumptions": [
            f"inputs: any sequence with {spans}, held over {sampling_time:g} s",
            *assumptions,
            "library functions err by less than 8 units in the last place",
        ],
    }


def _write(content: dict[str, Any], path: Path, *, json: bool) -> None:
    from asia.control.certificate import text_lines

    path.write_text(jsonlib.dumps(content) + "\n", "utf-8")
    lines = [f"run {content['run']}, model {content['model']}", *text_lines(content)]
    for line in [jsonlib.dumps(content)] if json else [*lines, f"file      {path}"]:
        say(line)
    if not content["statements"]:
        say("no certificate")


def _exit(content: dict[str, Any], *, limits: bool) -> None:
    """Exit with 1 if nothing is proven, or not the limits of the outputs for every model."""
    proven: dict[str, set[str]] = {}
    for part in content.get("loops", [content]):
        kinds = {one["kind"] for one in part["statements"]}
        proven.setdefault(part["model"], set()).update(kinds)
    kept = all("output limits" in kinds for kinds in proven.values())
    if not any(proven.values()) or (limits and not kept):
        raise typer.Exit(1)


def _certified_loop(
    directory: Path, u: Sequence[str], y: Sequence[str], horizon: int, model: str | None,
    isolation: Any,
) -> tuple[dict[str, Any], Path]:  # fmt: skip
    """Certificate of the loop with the controller of `asia control`, and its file."""
    from asia._files import read_file
    from asia.control.closed_loop import INPUTS, certify_loop
    from asia.control.commands.control import loop_of_run
    from asia.control.design import SampledController
    from asia.control.report import CONTROL_FILE, LOOP_CERTIFICATE_FILE
    from asia.problem.load import load_lock
    from asia.search.run import LOCK

    if model is not None and not model.isdecimal():
        raise UserError(f"--model is '{model}', expected the number of an experiment")
    folder = directory / ("control" if model is None else f"control-{int(model)}")
    path, remedy = folder / CONTROL_FILE.name, "run asia control first"
    if not path.exists():
        raise UserError(f"there is no controller in {folder}: {remedy}")
    try:
        made = jsonlib.loads(read_file(path, remedy))
        kind, at, numbers = made["kind"], made["at"], dict(made["controller"])
        pair = str(made["input"]), str(made["output"])
        setpoint = float(made["setpoint"])
        for name, value in numbers.items():
            if isinstance(value, list):
                numbers[name] = np.array(value, np.float64)
            elif value is None:
                numbers[name] = -np.inf if name == "low" else np.inf
        controller = SampledController(**numbers)
    except (ValueError, TypeError, LookupError):
        raise UserError(f"{path} is no file of this version: run asia control again") from None
    if kind == "mpc":
        raise UserError("a predictive controller has no certificate: design one of --kind lqr")
    plants, _ = loop_of_run(directory, at, model, isolation, pair, continuous_time=False)
    problem = load_lock(directory / LOCK)
    given = next(one for one in problem.inputs if one.name == plants.u)
    output = next(one for one in problem.outputs if one.name == plants.y)
    signals = [Signal(n, s.unit) for n, s in zip(INPUTS, (output, given, output), strict=True)]
    noise = 3.0 * plants.noise
    limits = np.array([sorted((controller.y0, setpoint)), [0.0, 0.0], [-noise, noise]])
    _set_limits("--u", u, signals, limits)
    within = np.tile([-np.inf, np.inf], (2, 1))
    _set_limits("--y", y, (output, given), within)
    facts = _facts(
        plants.name, f"loop of {made['structure']} with {', '.join(plants.labels)}", signals,
        (output, given), limits, controller.sampling_time,
        f"start: at rest with {given.label} at {controller.u0:.6g}; the box holds it",
        "the statements are about these models, not about the system: model errors and noise "
        "beyond these limits are not part of them",
    )  # fmt: skip
    content = certify_loop(
        plants, controller, limits, horizon, facts, within if y else None,
        lambda line: say(line, file=sys.stderr, flush=True),
    )  # fmt: skip
    return content, folder / LOOP_CERTIFICATE_FILE.name


def _set_limits(
    option: str, texts: Sequence[str], signals: Sequence[Signal], limits: np.ndarray
) -> None:
    """Write limits such as `0..10` for all signals or `name=0..10` for one to (n, 2)."""
    names = [one.name for one in signals]
    for text in texts:
        name, equals, span = text.rpartition("=")
        try:
            low, high = (float(word) for word in span.split(".."))
            rows = [names.index(name)] if equals else range(len(names))
            if not -np.inf < low <= high < np.inf:
                raise ValueError
        except ValueError:
            raise UserError(
                f"{option} is '{text}', expected limits such as 0..10 or {names[0]}=0..10"
            ) from None
        limits[list(rows)] = low, high
