"""asia control: a controller for the model of a run, or for a transfer function."""

from __future__ import annotations

import ast
import json as jsonlib
import math
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from asia._text import say
from asia.errors import UserError
from asia.interfaces.cli.options import (
    DEFAULT_RUNS,
    CandidateLevel,
    Json,
    RunName,
    Runs,
    candidate_level,
    run_directory,
)

if TYPE_CHECKING:
    from asia.analysis.control import Design, LoopFigures, Transfer


def control(
    run: RunName = None,
    plant: Annotated[
        str | None,
        typer.Option(help='Transfer function in place of a run, such as "1.3/(s+12.7)".'),
    ] = None,
    delay: Annotated[float, typer.Option(help="Dead time of --plant in s.")] = 0.0,
    at: Annotated[
        str | None,
        typer.Option(help="Operating point of a run, as for asia linear: u=2.5 or y=9."),
    ] = None,
    gain_margin: Annotated[
        float | None, typer.Option(help="Least gain margin as a factor; default: 2.")
    ] = None,
    phase_margin: Annotated[
        float | None, typer.Option(help="Least phase margin in degrees; default: 45.")
    ] = None,
    settling: Annotated[
        float | None, typer.Option(help="Longest 2 % settling time of a step in s.")
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
    seed: Annotated[int, typer.Option(help="Seed of the optimisation.")] = 0,
    isolation: CandidateLevel = None,
    runs: Runs = DEFAULT_RUNS,
    json: Json = False,
) -> None:
    """Design a PID or lead-lag controller that meets specifications, for the linear model of a run
    and of all its fold models, or for a transfer function."""
    from asia.analysis.control import Specification, Transfer, design, loop_figures

    wanted = Specification(
        2.0 if gain_margin is None else gain_margin,
        45.0 if phase_margin is None else phase_margin,
        settling_least,
        settling,
        10.0 if overshoot is None else overshoot,
        1e-3 if steady_state is None else steady_state,
    )
    if plant is not None:
        if run is not None:
            raise UserError("give a run or --plant, not both")
        num, den = rational(plant)
        if len(num) > len(den) or not np.any(num) or delay < 0:
            raise UserError(
                f"--plant '{plant}' has no proper transfer function, or --delay is negative"
            )
        plants, name = [Transfer(num, den, delay)], plant
    else:
        directory = run_directory(runs, run)
        plants = _plants(str(directory), at, candidate_level(isolation))
        name = directory.name
    found = design(plants, wanted, seed=seed)
    each = [loop_figures(one, found.controller) for one in plants]
    if json:
        say(jsonlib.dumps(_facts(name, found, each), allow_nan=False))
        return
    say(f"plant     {name}" + (f", {len(plants) - 1} fold models beside it" * (len(plants) > 1)))
    say(f"structure {found.structure}")
    say(f"C(s)      {_text(found.controller)}")
    for line in _pid_lines(found.controller):
        say(line)
    for number, figures in enumerate(each):
        which = "loop" if number == 0 else f"fold {number}"
        say(
            f"{which:<9} gain margin {figures.gain_margin:.3g}, phase margin "
            f"{figures.phase_margin:.3g} degrees, settling {figures.settling:.4g} s, overshoot "
            f"{figures.overshoot:.3g} %, steady-state error {abs(figures.steady_state):.2g}"
            if figures.stable
            else f"{which:<9} unstable"
        )
    if found.violated:
        say(
            f"missed    {', '.join(found.violated)}: no controller was found that meets all "
            "specifications; relax one of them or try another --seed"
        )
        raise typer.Exit(1)


def _plants(directory: str, at: str | None, isolation: Any) -> list[Transfer]:
    """Continuous-time transfer functions of the model and the fold models of a run."""
    from asia.analysis.control import Transfer
    from asia.export.linear import linearize
    from asia.lowering.linear import continuous

    found = linearize(directory, [at] if at else (), isolation=isolation)
    if len(found.inputs) != 1 or len(found.outputs) != 1:
        raise UserError(
            f"the model has {len(found.inputs)} inputs and {len(found.outputs)} outputs: a "
            "controller is designed for one input and one output"
        )
    point, plants = found.points[0], list[Transfer]()
    for model in (point.model, *point.folds):
        same, dead = continuous(model)
        numerators, den = same.numerator()
        num = numerators[0][0]
        num = np.where(np.abs(num) > 1e-9 * np.abs(num).max(), num, 0.0)
        # A controller acts once a sample: half a sample of dead time more.
        late = (dead + 0.5) * model.sampling_time
        plants.append(Transfer(np.trim_zeros(num, "f"), den, late))
    return plants


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
    def finite(value: float) -> float | None:
        return float(value) if math.isfinite(value) else None

    gains = pid_gains(found.controller)
    return {
        "plant": name,
        "structure": found.structure,
        "num": found.controller.num.tolist(),
        "den": found.controller.den.tolist(),
        "pid": None if gains is None else dict(zip(("Kp", "Ki", "Kd", "Tf"), gains, strict=True)),
        "loops": [
            {
                "stable": one.stable,
                "gain_margin": finite(one.gain_margin),
                "phase_margin": finite(one.phase_margin),
                "settling": finite(one.settling),
                "overshoot": finite(one.overshoot),
                "steady_state": finite(one.steady_state),
            }
            for one in each
        ],
        "missed": list(found.violated),
    }
