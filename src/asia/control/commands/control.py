"""asia control: a controller for the model of a run, or for a transfer function."""

from __future__ import annotations

import ast
import json as jsonlib
import math
import sys
from collections.abc import Sequence
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from asia._text import say
from asia.errors import UserError
from asia.interfaces.cli.options import RunName, RunOptions
from asia.interfaces.cli.output import plain

if TYPE_CHECKING:
    from asia.control.design import (
        Design,
        Loop,
        LoopFigures,
        PlantStep,
        ResponseFigures,
        SampledController,
        Transfer,
    )
    from asia.data.trajectory import Signal
    from asia.ledger.evidence import DrawnCheck
    from asia.lowering.linear import LinearModel
    from asia.lowering.program import LoweredModel

_LOOP_FIGURES = (
    "stable", "gain_margin", "phase_margin", "settling", "overshoot", "steady_state",
)  # fmt: skip
# Files of the controller.
_CODE = {"python": "controller.py", "c": "controller.c", "st": "controller.st"}
_KINDS = ("pid", "lqr", "mpc")
# Candidates of other families, and their largest V in that of the best.
_OTHERS, _FAR = 2, 1.5
# Share of a step that the models may miss before it is a warning.
_UNMODELLED = 0.04
# Share of the impulse response that a linear model may lose with modes that have no continuous
# equivalent, such as parts of a sample of dead time.
_FAST = 0.05


def control(
    *,
    run: RunName = None,
    plant: Annotated[
        str | None,
        typer.Option(help='Transfer function in place of a run, such as "1.3/(s+12.7)".'),
    ] = None,
    delay: Annotated[float, typer.Option(help="Dead time of --plant in s.")] = 0.0,
    kind: Annotated[
        str, typer.Option(help="pid (P to PID with lead-lag), lqr or mpc (predictive).")
    ] = "pid",
    weights: Annotated[
        str | None,
        typer.Option(
            help="Weights of squared errors and squared inputs of lqr and mpc, such as y=1,u=0.1; "
            "default: the least input that meets the specifications."
        ),
    ] = None,
    moves: Annotated[
        int | None, typer.Option(min=1, max=200, help="Planned inputs of mpc; default: 10 to 40.")
    ] = None,
    at: Annotated[
        str | None,
        typer.Option(
            help="Operating point of a run, as for asia linear: NAME=VALUE,... of inputs or "
            "outputs."
        ),
    ] = None,
    input_: Annotated[
        str | None,
        typer.Option(
            "--input", help="Input that the controller sets; default: the only one that is set."
        ),
    ] = None,
    output: Annotated[
        str | None,
        typer.Option("--output", help="Output with the set point; default: the only one."),
    ] = None,
    model: Annotated[
        str | None,
        typer.Option(
            help="Number of an experiment of the run, whose folder is control-N; default: the "
            "model to use."
        ),
    ] = None,
    gain_margin: Annotated[
        float | None, typer.Option(help="Least gain margin as a factor; default: 2.")
    ] = None,
    phase_margin: Annotated[
        float | None, typer.Option(help="Least phase margin in degrees; default: 45.")
    ] = None,
    settling: Annotated[
        float | None,
        typer.Option(
            help="Longest 2 % settling time of a step in s; default: that of the plant itself."
        ),
    ] = None,
    settling_least: Annotated[
        float | None, typer.Option(help="Shortest 2 % settling time in s, to spare the actuator.")
    ] = None,
    overshoot: Annotated[
        float | None, typer.Option(help="Largest overshoot in %; default: 10.")
    ] = None,
    steady_state: Annotated[
        float | None,
        typer.Option(help="Largest steady-state error of a step; default: 0.001."),
    ] = None,
    setpoint: Annotated[
        float | None,
        typer.Option(
            help="Set point of the simulated step; default: the operating point plus a standard "
            "deviation of the training outputs, 1 for --plant."
        ),
    ] = None,
    limits: Annotated[
        str | None, typer.Option(help="Limits of the input, such as u=0..10; default: none.")
    ] = None,
    rate: Annotated[
        float | None, typer.Option(help="Largest change of the input in a second; default: none.")
    ] = None,
    sampling_time: Annotated[
        float | None,
        typer.Option(
            help="Sampling time in s of the controller for --plant; default: a 200th of the "
            "settling time."
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(help="Folder for the picture and the code; default: control in the run."),
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of the optimisation.")] = 0,
    options: RunOptions,
) -> None:
    """Design a PID or lead-lag controller, an LQR or a predictive controller that meets
    specifications, for the linear model of a run and of all its fold models, or for a transfer
    function; simulate the loop with all models, and write the controller as code."""
    from asia.control.design import (
        Limits,
        Loop,
        SampledController,
        Specification,
        Transfer,
        design_in_simulation,
        pid_designer,
        shortfalls,
        simulate_loop,
    )
    from asia.control.state_feedback import state_feedback_designer

    wanted = Specification(
        2.0 if gain_margin is None else gain_margin,
        45.0 if phase_margin is None else phase_margin,
        settling_least,
        settling,
        10.0 if overshoot is None else overshoot,
        1e-3 if steady_state is None else steady_state,
    )
    if model is not None and not model.isdecimal():
        raise UserError(f"--model is '{model}', expected the number of an experiment")
    if kind not in _KINDS:
        raise UserError(f"--kind is '{kind}', expected {', '.join(_KINDS)}")
    if kind == "pid" and (weights is not None or moves is not None):
        raise UserError("--weights and --moves are for --kind lqr and mpc")
    beside: list[str] = []
    if plant is not None:
        if run is not None or model is not None or input_ is not None or output is not None:
            raise UserError("give a run or --plant, not both: the other options are for a run")
        num, den = rational(plant)
        if len(num) > len(den) or not np.any(num) or delay < 0:
            raise UserError(
                f"--plant '{plant}' has no proper transfer function, or --delay is negative"
            )
        loop = Loop(plant, ("loop",), [Transfer(num, den, delay)], [], sampling_time or 0.0)
    else:
        if sampling_time is not None:
            raise UserError("--sampling-time is for --plant: a run has its own")
        directory = options.directory(run)
        loop, beside = loop_of_run(
            directory, at, model, options.level, (input_, output), continuous_time=kind == "pid"
        )
        out = out or directory / ("control" if model is None else f"control-{model}")
    low, high = _limits(limits, loop.u)
    shares = None if weights is None else _weights(weights, loop)
    if rate is not None and not rate > 0:
        raise UserError(f"--rate is {rate:g}, expected a positive number")
    if not low <= loop.u0 <= high:
        raise UserError(
            f"--limits {limits}: the input at the operating point is {loop.u0:.5g}; choose another "
            "point by --at"
        )
    if setpoint is not None:
        loop = replace(loop, setpoint=setpoint)
    if loop.setpoint == loop.y0:
        raise UserError(f"--setpoint {loop.setpoint:g} is the output at the operating point")
    own = loop.own_settling
    if settling is None and settling_least is None and own is not None:
        wanted = replace(wanted, settling_max=own)
    limited = Limits(low, high, rate or math.inf)
    designer = (
        pid_designer(limited, seed, lambda text: say(f"tried     {text}", file=sys.stderr))
        if kind == "pid"
        else state_feedback_designer(limited, predictive=kind == "mpc", weights=shares, moves=moves)
    )
    made = design_in_simulation(loop, wanted, designer)
    loop, found, each, controller = made.loop, made.design, made.figures, made.controller
    responses, judged, missed = made.responses, made.judged, made.missed
    noisy = None
    if loop.noise:
        drawn = loop.noise * np.random.default_rng(seed).standard_normal(len(responses[0][0]))
        noisy = simulate_loop(controller, loop.simulated[0], made.target, drawn)
    facts = _facts(loop.name, found, each)
    facts["sampling_time"] = loop.sampling_time
    facts["model"] = f"experiment {model}" if model else "the model to use"
    facts["responses"] = [
        {"model": one.name, **plain(asdict(f))}
        for one, f in zip(loop.simulated, judged, strict=True)
    ]
    facts["missed_in_simulation"] = missed
    numbers = {one.name: getattr(controller, one.name) for one in fields(SampledController)}
    facts |= {"kind": kind, "at": at, "setpoint": loop.setpoint, "controller": plain(numbers)}
    facts |= {"input": loop.u, "output": loop.y, "samples": len(made.target)}
    lines = _lines(loop, found, each, judged)
    lines[1:1] = beside
    if noisy is not None:
        moved = float(np.nanstd(noisy[1] - responses[0][1]))
        lines.append(f"noise     {loop.y} {loop.noise:.3g} moves {loop.u} by {moved:.3g} (std)")
    lines.append(f"weakest   {_weakest(loop, each, responses, controller)}")
    facts["unmodelled"] = loop.unmodelled
    if loop.unmodelled > _UNMODELLED:
        lines.append(
            f"warning   on held-out data the models miss {100 * loop.unmodelled:.2g} % of this "
            "step beyond the noise: all of them may err alike"
        )
    files: list[Path] = []
    if out is not None:
        from asia.control.drawing import draw_control
        from asia.control.report import CONTROL_FILE
        from asia.report.files import save

        named = [(p.name, y, u) for p, (y, u) in zip(loop.simulated, responses, strict=True)]
        names, ends = (loop.y, loop.u), (low, high)

        def draw() -> Any:
            return draw_control(named, noisy, loop.sampling_time, loop.setpoint, ends, names)

        files = [*save([("control", draw)], out)]
        for language, file in _CODE.items():
            # Code of another kind of controller that was here before does not belong to this one.
            (out / file).unlink(missing_ok=True)
            if kind != "mpc" or language == "python":
                (out / file).write_text(controller.code(language), "utf-8")  # pyright: ignore[reportArgumentType]
                files.append(out / file)
        drawn = [asdict(one) for one in _drawn(loop, named)]
        page = {**facts, "text": [*lines, *(f"missed    {m}" for m in missed)], "drawn": drawn}
        (out / CONTROL_FILE.name).write_text(jsonlib.dumps(page, allow_nan=False) + "\n", "utf-8")
        files.append(out / CONTROL_FILE.name)
    if options.json:
        say(jsonlib.dumps(facts, allow_nan=False))
    options.print(() if options.json else lines, files)
    if options.json:
        return
    if found.violated:
        say(
            f"missed    {', '.join(shortfalls(each, wanted))}: no controller was found that meets "
            "all specifications; relax one of them or try another "
            f"{'--seed' if kind == 'pid' else '--kind'}"
        )
    for one in missed:
        say(f"missed    {one}")
    if found.violated or missed:
        raise typer.Exit(1)


def _drawn(loop: Loop, responses: Sequence[tuple[str, np.ndarray, np.ndarray]]) -> list[DrawnCheck]:
    """Step responses of all models, for the report and the live page; not those that diverge."""
    from asia.ledger.evidence import DrawnCheck, DrawnCurve

    panels: list[DrawnCheck] = []
    for column, name in ((1, loop.y), (2, loop.u)):
        curves: list[DrawnCurve] = []
        for response in responses:
            values = np.asarray(response[column])
            every = max(len(values) // 300, 1)
            if np.isfinite(values).all():
                time = loop.sampling_time * np.arange(len(values))[::every]
                curves.append(DrawnCurve(response[0], time.tolist(), values[::every].tolist()))
        title, axes = f"step of the set point: {name}", ("time [s]", name)
        panels.append(DrawnCheck(title, axes, tuple(curves)))
    return panels


def _limits(text: str | None, name: str) -> tuple[float, float]:
    if text is None:
        return -math.inf, math.inf
    side, _, ends = text.rpartition("=")
    try:
        low, high = (float(one) for one in ends.split(".."))
    except ValueError:
        low = high = math.nan
    if side not in ("", "u", name) or not low < high:
        raise UserError(f"--limits is '{text}', expected u=LOW..HIGH, such as u=0..10")
    return low, high


def _weights(text: str, loop: Loop) -> tuple[float, float]:
    """Weights of y and u."""
    pairs = [one.partition("=") for one in text.split(",")]
    try:
        found = {name.strip(): float(value) for name, _, value in pairs}
        y, u = (found.pop(own, found.pop(one, 1.0)) for own, one in ((loop.y, "y"), (loop.u, "u")))
        if found or not (0 < y < math.inf and 0 < u < math.inf):
            raise ValueError
    except ValueError:
        raise UserError(
            f"--weights is '{text}', expected positive numbers such as y=1,u=0.1"
        ) from None
    return y, u


def loop_of_run(
    directory: Path, at: str | None, number: str | None, isolation: Any,
    pair: tuple[str | None, str | None] = (None, None), *, continuous_time: bool,
) -> tuple[Loop, list[str]]:  # fmt: skip
    """Plants of the model, of the fold models and of the best candidates of other families of a
    run: linear models for the design, in continuous time as transfer functions, and nonlinear ones
    for the simulation. The inputs beside the chosen one are held at the operating point; a line on
    each of them is the second result."""
    from asia.control.closed_loop import single_loop
    from asia.control.design import Loop, SimulatedPlant, Transfer
    from asia.export.linear import LinearPoint, linearize
    from asia.ledger.run import open_run
    from asia.lowering.evaluation import evaluate
    from asia.lowering.linear import continuous, joined, split
    from asia.problem.load import load_lock
    from asia.search.extension import leading_experiments
    from asia.search.run import LOCK

    opened, problem = open_run(directory), load_lock(directory / LOCK)
    j = chosen("--input", pair[0], problem.inputs, [s.is_actuated for s in problem.inputs])
    i = chosen("--output", pair[1], problem.outputs, [True] * len(problem.outputs))
    found = linearize(opened, [at] if at else (), number, isolation=isolation)
    point = found.points[0]
    own, y0 = opened.view.best, float(point.at.y[i])
    others: dict[str, LinearPoint] = {}
    # An experiment that is asked for is judged by its own models.
    leading = leading_experiments(opened.view, 1 + _OTHERS, _FAR) if number is None else []
    for one in leading:
        if own is None or one.proposed.family == own.proposed.family:
            continue
        try:
            there = linearize(opened, [point.at.u], str(one.number), isolation=isolation)
        except UserError:
            continue
        nearest = min(there.points, key=lambda place: abs(float(place.at.y[i]) - y0))
        others[f"#{one.number:02d} {one.proposed.family}"] = nearest
    models = [
        replace(
            m,
            b=m.b[:, [j]],
            c=m.c[[i]],
            d=m.d[[i]][:, [j]],
            u0=m.u0[[j]],
            y0=m.y0[[i]],
            inputs=m.inputs[j : j + 1],
        )
        for m in (point.model, *point.folds, *(one.model for one in others.values()))
    ]
    beside = _beside(point.model, found.inputs, found.outputs[i], i, j)
    if not models[0].delay[0, 0]:
        beside.append(
            f"note      {found.outputs[i].name} has the input of its own row at once: if the log "
            "writes outputs after inputs, the loop has one sample of dead time more"
        )

    def transfer(model: LinearModel) -> Transfer:
        same, dead = continuous(model, _FAST)
        numerators, den = same.numerator()
        num = np.trim_zeros(numerators[0][0], "f")
        return Transfer(num, den, dead * model.sampling_time)

    plants = [transfer(model) for model in models] if continuous_time else []

    def step_of(of: LoweredModel) -> PlantStep:
        def step(x: np.ndarray, u: float) -> tuple[float, np.ndarray]:
            y, *states = evaluate(of.step, [*split(of, x), np.array([u])])
            return float(y[0]), joined(states)

        return step

    labels = ("loop", *(f"fold {k}" for k in range(1, 1 + len(point.folds))), *others)
    lowered = [
        (single_loop(model, place, i, j), place)
        for model, place in (*point.steps, *(one.steps[0] for one in others.values()))
    ]
    steps = [step_of(model) for model, _ in lowered]
    starts = [place.x for _, place in lowered]
    simulated = [
        SimulatedPlant(label, [step], [x], [of])
        for label, step, x, (of, _) in zip(labels, steps, starts, lowered, strict=True)
    ]
    folds = slice(1, 1 + len(point.folds))
    if len(point.folds) > 1:
        simulated.append(SimulatedPlant("mean of folds", steps[folds], starts[folds]))
    y = np.concatenate([record.measured_y[:, i] for record in found.records])
    u = np.concatenate([record.u[:, j] for record in found.records])
    noise = float(found.noise[i])
    scored = next((one for one in opened.view.experiments if str(one.number) == number), own)
    folds_of = () if scored is None or scored.score is None else scored.score.folds
    error = float(np.mean([one.rmse[i] for one in folds_of])) if folds_of else 0.0
    return Loop(
        found.name, labels, plants, simulated, point.model.sampling_time, float(point.at.u[j]), y0,
        y0 + float(np.nanstd(y)), noise, error, (float(u.min()), float(u.max())),
        found.inputs[j].name, found.outputs[i].name, models,
    ), beside  # fmt: skip


def chosen(option: str, name: str | None, signals: Sequence[Signal], free: Sequence[bool]) -> int:
    """Place of the signal that is named, or of the only free one."""
    names = [one.name for one in signals]
    places = [k for k, one in enumerate(free) if one and name in (None, names[k])]
    if len(places) != 1:
        known = ", ".join(n for n, one in zip(names, free, strict=True) if one) or "none"
        wrong = f"is '{name}'" if name is not None else "is missing"
        why = f"; {name} is a disturbance, which nobody sets" if name in names else ""
        raise UserError(f"{option} {wrong}: expected one of {known}{why}")
    return places[0]


def _beside(
    model: LinearModel, inputs: Sequence[Signal], output: Signal, i: int, j: int
) -> list[str]:
    """Lines on the inputs that the controller does not set, with the static feedforward of a
    measured disturbance."""
    lines: list[str] = []
    for k, one in enumerate(inputs):
        if k == j:
            continue
        text = f"held      {one.name} at {model.u0[k]:.5g} {one.unit}".rstrip()
        gains = model.gain[i, [j, k]]
        if one.role == "disturbance" and np.isfinite(gains).all() and gains[0]:
            unit = f" {inputs[j].unit}/{one.unit}" if one.unit and inputs[j].unit else ""
            text += (
                f"; {output.name} moves by {gains[1]:.4g} for 1; feedforward: add "
                f"{-gains[1] / gains[0]:.4g}{unit} times its deviation to {inputs[j].name}"
            )
        lines.append(text)
    return lines


def _lines(
    loop: Loop, found: Design, each: Sequence[LoopFigures], judged: Sequence[ResponseFigures]
) -> list[str]:
    """Gains, margins of the linear models and figures of the simulated responses."""
    folds = sum(one.startswith("fold") for one in loop.labels)
    lines = [f"plant     {loop.name}" + (f", {folds} fold models beside it" * (folds > 0))]
    lines.append(f"structure {found.structure}")
    if found.weights is not None:
        lines.append(
            "weights   "
            + ",".join(f"{n}={w:.4g}" for n, w in zip("yu", found.weights, strict=True))
        )
    if found.controller is not None:
        lines += [f"C(s)      {_text(found.controller)}", *_pid_lines(found.controller)]
    lines.append(f"sampling  {loop.sampling_time:g} s")
    for label, figures in zip(loop.labels, each, strict=True):
        lines.append(
            f"{_column(label)} gain margin {figures.gain_margin:.3g}, phase margin "
            f"{figures.phase_margin:.3g} degrees, settling {figures.settling:.4g} s, overshoot "
            f"{figures.overshoot:.3g} %, steady-state error {abs(figures.steady_state):.2g}"
            if figures.stable
            else f"{_column(label)} unstable"
        )
    lines.append(f"step      {loop.y} from {loop.y0:.5g} to {loop.setpoint:.5g}, simulated")
    for one, f in zip(loop.simulated, judged, strict=True):
        lines.append(
            f"{_column(one.name)} rise {f.rise:.4g} s, settling {f.settling:.4g} s, overshoot "
            f"{f.overshoot:.3g} %, IAE {f.iae:.4g}, ISE {f.ise:.4g}, ITAE {f.itae:.4g}, effort "
            f"{f.effort:.4g}, at a limit {100 * f.limited:.3g} % of the time"
        )
    if len(judged) > 1:
        least, most = (found(f.iae for f in judged) for found in (min, max))
        lines.append(f"spread    IAE {least:.4g} to {most:.4g} over these models")
    return lines


def _column(label: str) -> str:
    """Name of a model in the first column: `#06` for `#06 nl_lfr`, `mean` for `mean of folds`."""
    return f"{label if label.startswith('fold') else label.partition(' ')[0]:<9}"


def _weakest(
    loop: Loop, each: Sequence[LoopFigures], responses: Sequence[tuple[np.ndarray, np.ndarray]],
    controller: SampledController,
) -> str:  # fmt: skip
    """A sentence on the smallest changes that make the loop fail."""
    rows = list(zip(loop.labels, each, strict=True))
    if not all(one.stable for one in each):
        return "a linear model is unstable in the loop"
    label, one = min(rows, key=lambda row: row[1].delay_margin)
    parts: list[str] = []
    if math.isfinite(one.delay_margin):
        parts.append(f"{one.delay_margin:.3g} s more dead time ({label})")
    label, one = min(rows, key=lambda row: row[1].gain_high)
    if math.isfinite(one.gain_high):
        parts.append(f"{one.gain_high:.3g} times the gain of the plant ({label})")
    label, one = max(rows, key=lambda row: row[1].gain_low)
    if one.gain_low:
        parts.append(f"a gain of the plant {one.gain_low:.3g} times as large ({label})")
    text = (
        f"the loop becomes unstable with {' or '.join(parts)}" if parts else "no margin is finite"
    )
    u = np.concatenate([one for _, one in responses])
    low, high = loop.u_range
    slack = 1e-9 * (high - low)
    if np.nanmin(u) < low - slack or np.nanmax(u) > high + slack:
        text += (
            f"; {loop.u} goes from {np.nanmin(u):.4g} to {np.nanmax(u):.4g}, outside its training "
            f"range {low:.4g} to {high:.4g}, where the models are not tested"
        )
    end = np.array([one[-1] for _, one in responses if np.isfinite(one[-1])])
    room = np.minimum(end - controller.low, controller.high - end).min(initial=math.inf)
    if math.isfinite(room) and room >= 0:
        text += f"; at the set point {loop.u} has {room:.3g} left to its limit"
    return text


def rational(text: str) -> tuple[np.ndarray, np.ndarray]:
    """Numerator and denominator, the highest power first, of a rational function of s.

    Raises:
        UserError: for anything but numbers, s, + - * / ** and parentheses
    """

    def computed(node: ast.expr) -> tuple[np.ndarray, np.ndarray]:
        match node:
            case ast.Constant(value=int() | float() as value):
                return np.array([float(value)]), np.ones(1)
            case ast.Name(id="s"):
                return np.array([1.0, 0.0]), np.ones(1)
            case ast.UnaryOp(op=ast.USub(), operand=one):
                num, den = computed(one)
                return -num, den
            case ast.BinOp(left=left, op=ast.Pow(), right=ast.Constant(value=int() as power)) if (
                0 <= power <= 20
            ):
                num, den = computed(left)
                whole = np.ones(1), np.ones(1)
                for _ in range(power):
                    whole = np.polymul(whole[0], num), np.polymul(whole[1], den)
                return whole
            case ast.BinOp(left=left, op=op, right=right):
                (a, b), (c, d) = computed(left), computed(right)
                match op:
                    case ast.Add():
                        return np.polyadd(np.polymul(a, d), np.polymul(c, b)), np.polymul(b, d)
                    case ast.Sub():
                        return np.polysub(np.polymul(a, d), np.polymul(c, b)), np.polymul(b, d)
                    case ast.Mult():
                        return np.polymul(a, c), np.polymul(b, d)
                    case ast.Div() if np.any(c):
                        return np.polymul(a, d), np.polymul(b, c)
                    case _:
                        raise ValueError
            case _:
                raise ValueError

    try:
        tree = ast.parse(text.replace("^", "**"), mode="eval")
        num, den = computed(tree.body)
    except (SyntaxError, ValueError, RecursionError):
        raise UserError(
            f"--plant is '{text}', expected a rational function of s, such as '1.3/(s+12.7)' or "
            "'2*(s+1)/(s^2+3*s+2)'"
        ) from None
    return np.trim_zeros(num, "f") if np.any(num) else np.zeros(1), np.trim_zeros(den, "f")


def _text(one: Transfer) -> str:
    """`(0.5 s + 1) / (s)`."""

    def polynomial(values: Any) -> str:
        most = len(values) - 1
        terms = [
            f"{value:.6g}" + ("" if k == most else " s" if most - k == 1 else f" s^{most - k}")
            for k, value in enumerate(values)
            if value != 0
        ]
        return f"({' + '.join(terms)})".replace("+ -", "- ")

    return f"{polynomial(one.num)} / {polynomial(one.den)}"


def pid_gains(one: Transfer) -> tuple[float, float, float, float] | None:
    """Kp, Ki, Kd and the time constant Tf of the filter, of Kp + Ki / s + Kd s / (Tf s + 1); None
    for a controller that is no PID."""
    num, den = one.num / den_last(one.den), one.den / den_last(one.den)
    if len(den) == 1 and len(num) == 1:
        return float(num[0]), 0.0, 0.0, 0.0
    if den[-1] != 0 or len(den) > 3 or len(num) > len(den):
        return None
    # den = Tf s^2 + s, num = a s^2 + b s + c.
    tf = float(den[0]) if len(den) == 3 else 0.0
    padded = np.concatenate([np.zeros(3 - len(num)), num])
    ki = float(padded[2])
    kp = float(padded[1]) - ki * tf
    kd = float(padded[0]) - kp * tf
    return kp, ki, kd, tf


def den_last(den: np.ndarray) -> float:
    """Coefficient that becomes 1: that of s, or the constant one."""
    return float(den[-2] if len(den) > 1 and den[-1] == 0 else den[-1])


def _pid_lines(one: Transfer) -> list[str]:
    gains = pid_gains(one)
    if gains is None:
        return []
    kp, ki, kd, tf = gains
    lines = [f"parallel  Kp {kp:.6g}, Ki {ki:.6g} 1/s, Kd {kd:.6g} s, filter Tf {tf:.6g} s"]
    if kp:
        ti = kp / ki if ki else math.inf
        lines.append(f"ideal     K {kp:.6g}, Ti {ti:.6g} s, Td {kd / kp:.6g} s, Tf {tf:.6g} s")
    return lines


def _facts(name: str, found: Design, each: list[LoopFigures]) -> dict[str, Any]:
    one = found.controller
    gains = None if one is None else pid_gains(one)
    return {
        "plant": name,
        "structure": found.structure,
        "weights": found.weights,
        "num": None if one is None else one.num.tolist(),
        "den": None if one is None else one.den.tolist(),
        "pid": None if gains is None else dict(zip(("Kp", "Ki", "Kd", "Tf"), gains, strict=True)),
        "loops": [{name: plain(getattr(one, name)) for name in _LOOP_FIGURES} for one in each],
        "missed": list(found.violated),
    }
