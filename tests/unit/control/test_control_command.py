"""asia control: controllers that python-control finds to meet the specifications."""

from __future__ import annotations

import ctypes
import json
import math
import re
import shutil
import subprocess
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import control
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from asia.control.commands.control import chosen, pid_gains, rational
from asia.control.design import (
    ControlledPlant,
    Loop,
    LoopFigures,
    SampledController,
    SimulatedPlant,
    Specification,
    Transfer,
    design,
    loop_figures,
    response_figures,
    sampled,
    sampled_loop_figures,
    sampled_plant,
    shortfalls,
    simulate_loop,
    zero_order_hold,
)
from asia.data.trajectory import Signal
from asia.errors import UserError
from tests.unit.interfaces.cli.conftest import command_line


@pytest.mark.parametrize(
    ("text", "num", "den"),
    [
        ("1.3/(s+12.7)", [1.3], [1.0, 12.7]),
        ("2*(s+1)/(s^2+3*s+2)", [2.0, 2.0], [1.0, 3.0, 2.0]),
        ("-5/s**2", [-5.0], [1.0, 0.0, 0.0]),
        ("1/(s+1) - 1/(s+2)", [1.0], [1.0, 3.0, 2.0]),
    ],
)
def test_a_transfer_function_is_read(text: str, num: list[float], den: list[float]) -> None:
    found = rational(text)
    assert found[0] == pytest.approx(num)
    assert found[1] == pytest.approx(den)


@pytest.mark.parametrize("text", ["z/(z+1)", "1/0", "exp(-s)", "s.real", "(1", "1 if s else 2"])
def test_anything_else_is_refused(text: str) -> None:
    with pytest.raises(UserError, match="expected a rational function of s"):
        rational(text)


@settings(max_examples=12)
@given(st.integers(0, 10_000))
def test_figures_agree_with_python_control(seed: int) -> None:
    rng = np.random.default_rng(seed)
    poles = -rng.uniform(0.2, 5.0, rng.integers(1, 4))
    plant = Transfer(np.array([float(rng.uniform(0.2, 3.0))]), np.poly(poles))
    controller = Transfer(rng.uniform(0.1, 2.0, 2), np.array([1.0, 0.0]))
    found = loop_figures(plant, controller)
    loop = control.tf(controller.num, controller.den) * control.tf(plant.num, plant.den)
    closed = control.feedback(loop, 1)
    assert found.stable == (np.real(closed.poles()).max() < 0)
    if not found.stable:
        return
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        gain, phase, _, _ = control.margin(loop)
        slow = np.abs(np.real(closed.poles())).min()
        _, y = control.step_response(closed, T=np.linspace(0, 12 / slow, 6000))
    assert found.phase_margin == pytest.approx(phase, abs=0.5)
    if np.isfinite(gain) and np.isfinite(found.gain_margin):
        assert found.gain_margin == pytest.approx(gain, rel=0.02)
    over = 100 * max(float(np.max(y)) / float(closed.dcgain()) - 1, 0.0)
    assert found.overshoot == pytest.approx(over, abs=0.3)


@pytest.mark.parametrize("delay", [0.0, 0.05])
def test_a_design_meets_its_specifications(delay: float) -> None:
    wanted = Specification(3.0, 55.0, None, 1.0, 8.0, 1e-3)
    num, den = rational("1.3/(s+12.7)")
    found = design([Transfer(num, den, delay)], wanted)
    assert found.violated == ()
    plant = control.tf(num, den)
    if delay:
        plant = plant * control.tf(*control.pade(delay, 5))
    loop = control.tf(found.controller.num, found.controller.den) * plant
    gain, phase, _, _ = control.margin(loop)
    info = control.step_info(control.feedback(loop, 1))
    assert gain >= 3.0
    assert phase >= 55.0
    assert info["SettlingTime"] <= 1.0
    assert info["Overshoot"] <= 8.0
    assert abs(1 - control.feedback(loop, 1).dcgain()) <= 1e-3


@pytest.mark.slow
def test_the_worst_of_several_plants_counts() -> None:
    wanted = Specification(2.0, 50.0, None, 4.0, 10.0, 1e-3)
    plants = [Transfer(np.array([k]), np.array([1.0, 1.2, 1.0])) for k in (1.0, 0.7, 1.4)]
    found = design(plants, wanted)
    assert found.violated == ()
    assert all(not loop_figures(one, found.controller).violations(wanted) for one in plants)


def test_a_plant_that_falls_with_its_input_gets_a_negative_controller() -> None:
    num, den = rational("-5/(s+1)")
    found = design([Transfer(num, den)], Specification(2.0, 45.0, None, 2.0, 10.0, 1e-3))
    assert found.violated == ()
    assert found.controller.num[0] < 0


def test_a_narrow_resonance_is_seen() -> None:
    # Two crossings within 1 % of the frequency, and a phase margin near 0 after them.
    plant = Transfer(np.array([0.05]), np.array([1.0, 0.002, 1.0]))
    found = loop_figures(plant, Transfer(np.ones(1), np.ones(1)))
    _, phase, _, _ = control.margin(control.tf([0.05], [1.0, 0.002, 1.0]))
    assert found.phase_margin == pytest.approx(phase, abs=1.0)


def test_an_impossible_specification_is_named_with_what_was_reached() -> None:
    # A right half plane zero at 1 rad/s forbids a settling time of 0.1 s without overshoot.
    num, den = rational("(1-s)/(s^2+2*s+1)")
    wanted = Specification(3.0, 60.0, None, 0.1, 1.0, 1e-3)
    tried: list[str] = []
    found = design([Transfer(num, den)], wanted, effort=5, report=tried.append)
    assert found.figures.stable
    assert found.violated
    assert all(":" in one for one in tried)
    assert tried[0].startswith("I: ")
    texts = shortfalls([found.figures], wanted)
    for name in found.violated:
        assert any(one.startswith(name.removesuffix(" too short")) for one in texts)


def test_shortfalls_give_the_worst_loop_and_the_limit() -> None:
    wanted = Specification(2.0, 60.0, None, 1.0, 5.0, 1e-3)
    poor = LoopFigures(True, 0.0, 4.0, 40.0, 3.0, 4.0, 0.0)
    poorer = LoopFigures(True, 0.0, 1.5, 30.0, 0.5, 4.0, 0.0)
    assert shortfalls([poor, poorer], wanted) == [
        "phase margin 30 degrees of at least 60 degrees",
        "settling time 3 s of at most 1 s",
        "gain margin 1.5 of at least 2",
    ]
    assert shortfalls([replace(poor, stable=False)], wanted) == ["no stable loop"]


@pytest.mark.slow
def test_an_unstable_oscillating_plant_is_met_by_one_design() -> None:
    # The gain may rise by 8 and must not fall by more; python-control agrees.
    num, den = rational("5.3/(s^2-1.05*s+0.54)")
    wanted = Specification(7.9, 58.0, 0.07, 8.0, 5.4, 1e-4)
    found = design([Transfer(num, den)], wanted)
    assert found.violated == ()
    loop = control.tf(found.controller.num, found.controller.den) * control.tf(num, den)
    gain, phase, _, _ = control.margin(loop)
    closed = control.feedback(loop, 1)
    info = control.step_info(closed, T=np.linspace(0.0, 24.0, 20_000))
    assert np.real(closed.poles()).max() < 0
    assert gain >= 7.9
    assert phase >= 58.0
    assert 0.07 <= info["SettlingTime"] <= 8.0
    assert info["Overshoot"] <= 5.4


def test_the_share_that_models_miss_leaves_out_the_noise() -> None:
    loop = Loop("run", ("loop",), [], [], 1.0, y0=2.0, setpoint=4.0, noise=0.3, error=0.5)
    assert loop.unmodelled == pytest.approx(0.2)
    assert replace(loop, error=0.2).unmodelled == 0.0


def test_pid_gains_give_the_same_controller() -> None:
    one = Transfer(np.array([0.4, 3.0, 2.0]), np.array([0.1, 1.0, 0.0]))
    gains = pid_gains(one)
    assert gains is not None
    kp, ki, kd, tf = gains
    s = np.array([0.3j, 2.0j, 50.0j])
    own = kp + ki / s + kd * s / (tf * s + 1)
    assert own == pytest.approx(one.response(s.imag))
    assert pid_gains(Transfer(np.ones(1), np.array([1.0, 2.0]))) is None


def test_the_command_prints_gains_and_figures() -> None:
    words = ("control", "--plant", "1.3/(s+12.7)", "--delay", "0.05", "--settling", "1")
    shown = command_line(*words)
    assert shown.code == 0, shown.err
    assert "phase margin" in shown.out
    found = json.loads(command_line(*words, "--json").out)
    assert found["missed"] == []
    assert found["loops"][0]["settling"] <= 1.0
    wrong = command_line("control", "--plant", "s/1")
    assert wrong.code == 2
    assert "no proper transfer function" in wrong.err


def test_gain_margins_of_an_unstable_plant_lie_on_both_sides() -> None:
    plant = Transfer(np.array([5.0]), np.array([1.0, -1.0]))
    controller = Transfer(np.array([2.0, 1.0]), np.polymul([1.0, 0.0], [0.01, 1.0]))
    found = loop_figures(plant, controller)
    loop = control.tf(controller.num, controller.den) * control.tf(plant.num, plant.den)
    gains = control.stability_margins(loop, returnall=True)[0]
    assert found.gain_low == pytest.approx(max(g for g in gains if g < 1), rel=0.02)
    assert found.gain_margin == pytest.approx(control.margin(loop)[0], rel=0.02)
    wanted = Specification(2.0, None, None, None, None, None)
    assert [name for name, _ in found.violations(wanted)] == ["gain margin"]


def test_the_delay_margin_is_the_dead_time_at_which_the_loop_becomes_unstable() -> None:
    num, den = rational("2/(s^2+1.2*s+1)")
    controller = Transfer(np.array([1.0, 0.5]), np.array([1.0, 0.0]))
    margin = loop_figures(Transfer(num, den), controller).delay_margin
    assert loop_figures(Transfer(num, den, 0.97 * margin), controller).stable
    assert not loop_figures(Transfer(num, den, 1.03 * margin), controller).stable


# The sampled controller in the simulated loop.

PLANT = Transfer(np.array([1.0]), np.array([1.0, 1.2, 1.0]), 0.13)
PID = Transfer(np.array([0.5, 0.9, 0.7]), np.array([0.2, 1.0, 0.0]))


def test_a_short_sampling_time_gives_the_continuous_response() -> None:
    figures = loop_figures(PLANT, PID)
    controller = sampled(PID, 0.005)
    y, u = simulate_loop(controller, zero_order_hold(PLANT, 0.005), np.ones(4000))
    found = response_figures(y, u, controller, 1.0)
    assert found.overshoot == pytest.approx(figures.overshoot, abs=0.5)
    assert found.settling == pytest.approx(figures.settling, rel=0.03)
    assert found.error < 1e-3
    # The integral of the error of a loop with an integrator is 1 / Ki of the whole loop.
    assert 0.005 * (1.0 - y).sum() == pytest.approx(1.0 / 0.7, rel=0.01)


@pytest.mark.parametrize("delay", [0.0, 0.1, 0.13])
def test_the_sampled_plant_is_exact_for_held_inputs(delay: float) -> None:
    plant = zero_order_hold(Transfer(np.array([2.0]), np.array([1.0, 0.5]), delay), 0.05)
    (step,), (x,) = plant.steps, plant.starts
    u = np.random.default_rng(0).standard_normal(60)
    found = np.empty(60)
    for k, value in enumerate(u):
        found[k], x = step(x, float(value))
    rows = np.repeat(u, 5)
    late = np.concatenate([np.zeros(round(delay / 0.01)), rows])[:300]
    fine = np.zeros(301)
    for k in range(300):
        fine[k + 1] = math.exp(-0.005) * fine[k] + 4.0 * (1.0 - math.exp(-0.005)) * late[k]
    assert found == pytest.approx(fine[:300:5], abs=1e-9)


def test_anti_windup_shortens_the_recovery_from_a_limit() -> None:
    plant = zero_order_hold(Transfer(np.array([1.0]), np.array([5.0, 1.0])), 0.05)
    limited = sampled(
        Transfer(np.array([4.0, 2.0]), np.array([1.0, 0.0])), 0.05, limits=(-1.5, 1.5)
    )
    winding = SampledController(
        np.eye(1), np.array([[2.0 * 0.05, -2.0 * 0.05, 0.0]]), limited.c, limited.d, 0.05,
        low=-1.5, high=1.5,
    )  # fmt: skip
    over: list[float] = []
    for one in (limited, winding):
        y, u = simulate_loop(one, plant, np.ones(800))
        assert np.abs(u).max() <= 1.5
        over.append(response_figures(y, u, one, 1.0).overshoot)
    assert over[0] < 0.5 * over[1]


def test_the_rate_of_the_input_is_limited() -> None:
    controller = sampled(PID, 0.05, rate=0.4)
    y, u = simulate_loop(controller, zero_order_hold(PLANT, 0.05), np.ones(1500))
    assert np.abs(np.diff(u, prepend=0.0)).max() <= 0.4 * 0.05 + 1e-12
    assert response_figures(y, u, controller, 1.0).error < 0.02


def test_a_diverging_loop_has_no_figures() -> None:
    plant = SimulatedPlant("loop", [lambda x, u: (float(x[0]), 3.0 * x + u)], [np.zeros(1)])
    controller = sampled(Transfer(np.array([0.1]), np.ones(1)), 1.0)
    found = response_figures(*simulate_loop(controller, plant, np.ones(100)), controller, 1.0)
    assert math.isinf(found.error)


# Code of the controller.


def python_step(folder: Path, code: SampledController) -> Callable[[float, float], float]:
    del folder
    names: dict[str, Any] = {}
    exec(code.code("python"), names)
    return names["Controller"]().step


def c_step(folder: Path, code: SampledController) -> Callable[[float, float], float]:
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler")
    source, library = folder / "controller.c", folder / "controller.so"
    source.write_text(code.code("c"), "utf-8")
    words = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-O2", "-shared", "-fPIC"]
    subprocess.run([compiler, *words, "-o", library, source, "-lm"], check=True)
    found = ctypes.CDLL(str(library))
    found.controller_step.restype = ctypes.c_double
    state = (ctypes.c_double * 16)()
    found.controller_reset(state, ctypes.c_double(code.u0))
    return lambda r, y: found.controller_step(state, ctypes.c_double(r), ctypes.c_double(y))


def st_step(folder: Path, code: SampledController) -> Callable[[float, float], float]:
    """Interpreter of declarations of LREAL and of assignments with + - *, MIN and MAX."""
    del folder
    text = re.sub(r"\(\*.*?\*\)", "", code.code("st"))
    declared, body = text.split("END_VAR\n", 3)[:3], text.split("END_VAR\n", 3)[3]
    values: dict[str, Any] = {"MIN": min, "MAX": max}
    for names, first in re.findall(r"([\w, ]+) : LREAL(?: := ([^;]+))?;", "".join(declared)):
        for name in names.split(","):
            values[name.strip()] = float(first or 0.0)
    lines = re.fullmatch(r"((?:    \w+ := [^;]+;\n)+)END_FUNCTION_BLOCK\n", body)
    assert lines is not None
    pairs = re.findall(r"(\w+) := ([^;]+);", lines.group(1))
    assert all(name in values for name, _ in pairs)

    def step(r: float, y: float) -> float:
        values.update(r=r, y=y)
        for name, expression in pairs:
            assert re.fullmatch(r"[\w\s.+\-*(),]+", expression)
            values[name] = eval(expression, {}, values)
        return values["u"]

    return step


def matrix_step(code: SampledController) -> Callable[[float, float], float]:
    """The controller by its definition, without its code."""
    x, last = np.zeros(len(code.c)), code.u0

    def step(r: float, y: float) -> float:
        nonlocal x, last
        v = code.u0 + code.c @ x + code.d @ [r - code.y0, y - code.y0]
        most = code.rate * code.sampling_time
        u = float(np.clip(np.clip(v, code.low, code.high), last - most, last + most))
        x = code.a @ x + code.b @ [r - code.y0, y - code.y0, u - code.u0]
        last = u
        return u

    return step


TRANSFERS = [
    PID,
    Transfer(np.array([3e-6]), np.array([1.0, 0.0])),
    Transfer(np.array([-2.0]), np.ones(1)),
    Transfer(np.array([0.4, 2.0]), np.array([0.001, 1.0])),
    Transfer(np.poly([-1.0, -2.0, -4.0]), np.poly([0.0, -20.0, -90.0])),
]


@pytest.mark.parametrize("made", [python_step, c_step, st_step])
@pytest.mark.parametrize("transfer", TRANSFERS)
def test_code_is_the_controller(
    made: Callable[[Path, SampledController], Callable[[float, float], float]],
    transfer: Transfer,
    tmp_path: Path,
) -> None:
    code = sampled(transfer, 0.05, u0=2.0, y0=-1.5, limits=(0.0, 4.5), rate=30.0)
    step, known = made(tmp_path, code), matrix_step(code)
    seen: list[float] = []
    for r, y in np.random.default_rng(0).normal(-1.5, 1.0, (400, 2)):
        seen.append(known(float(r), float(y)))
        assert step(float(r), float(y)) == pytest.approx(seen[-1], abs=1e-9)
    assert np.std(seen) > 1e-9


@pytest.mark.parametrize("transfer", TRANSFERS)
def test_a_controller_goes_on_from_the_input_it_is_started_with(transfer: Transfer) -> None:
    code = sampled(transfer, 0.05, u0=2.0, y0=-1.5, limits=(0.0, 4.5), rate=30.0)
    started = code.started(1.0)
    assert [started.step(-1.5, -1.5) for _ in range(50)] == pytest.approx([1.0] * 50, abs=1e-9)
    assert code.started().step(-1.5, -1.5) == pytest.approx(2.0)


def test_a_tiny_feedthrough_changes_nothing() -> None:
    # y = x and y = x + 1e-9 u are the same plant.
    steps = [lambda x, u, d=d: (float(x[0]) + d * u, 0.9 * x + 0.1 * u) for d in (0.0, 1e-9)]
    controller = sampled(Transfer(np.array([2.0, 1.0]), np.array([1.0, 0.0])), 0.1)
    responses = [
        simulate_loop(controller, SimulatedPlant("one", [step], [np.zeros(1)]), np.ones(100))
        for step in steps
    ]
    for one, other in zip(*responses, strict=True):
        assert one == pytest.approx(other, abs=1e-7)


@pytest.mark.parametrize("delay", [0.0, 0.05, 0.13])
@pytest.mark.parametrize("num", [[1.0], [0.3, 1.0, 1.0]])
def test_figures_of_the_sampled_loop_are_those_of_its_simulation(
    delay: float, num: list[float]
) -> None:
    plant = Transfer(np.array(num), np.array([1.0, 1.2, 1.0]), delay)
    controller = sampled(PID, 0.05)
    model = sampled_plant(plant, 0.05)
    found = sampled_loop_figures(ControlledPlant.of(model), controller)
    y, u = simulate_loop(controller, zero_order_hold(plant, 0.05), np.ones(3000))
    known = response_figures(y, u, controller, 1.0)
    assert found.settling == pytest.approx(known.settling, abs=1e-9)
    assert found.overshoot == pytest.approx(known.overshoot, abs=1e-9)
    assert found.rise == pytest.approx(known.rise, abs=1e-9)


def test_the_settling_time_of_a_plant_counts_all_its_lags() -> None:
    num, den = rational("1/(s+1)^8")
    found = Transfer(num, den, 0.5).own_settling
    y = control.step_response(control.tf(num, den), T=np.linspace(0.0, 40.0, 40_001))[1]
    known = 0.001 * float(np.flatnonzero(np.abs(y - 1.0) > 0.02)[-1])
    assert found == pytest.approx(known + 0.5, abs=0.03)


def test_limits_reach_the_simulation_and_the_files(tmp_path: Path) -> None:
    words = ("control", "--plant", "2/(5*s+1)", "--settling", "6", "--out", tmp_path, "--json")
    free = json.loads(command_line(*words).out)
    highest = 0.7
    shown = command_line(*words, "--limits", f"u=0..{highest}")
    found = json.loads(shown.out)
    assert found["responses"][0]["limited"] > 0
    assert found["responses"][0]["settling"] > free["responses"][0]["settling"]
    assert f"{highest})" in (tmp_path / "controller.c").read_text("utf-8")
    assert (tmp_path / "control.png").exists()
    below = command_line(*words[:-1], "--limits", "u=0..0.4")
    assert below.code == 1
    assert "does not reach the set point" in below.out
    for wrong in ("u=1..0", "u=1", "v=0..1", "u=a..b"):
        assert "expected u=LOW..HIGH" in command_line(*words, "--limits", wrong).err
    assert "choose another point" in command_line(*words, "--limits", "u=1..2").err


def test_a_loop_is_not_much_faster_than_asked() -> None:
    # Without a lower limit of the settling time a high gain would meet everything.
    found = design([Transfer(np.array([2.0]), np.array([5.0, 1.0]))],
                   Specification(2.0, 45.0, None, 6.0, 10.0, 1e-3))  # fmt: skip
    assert found.violated == ()
    assert 1.4 <= found.figures.settling <= 6.0
    assert found.controller.den[-1] == 0


def test_the_input_of_a_loop_is_the_only_one_that_is_set() -> None:
    signals = Signal("heater"), Signal("weather", role="disturbance")
    free = [one.is_actuated for one in signals]
    assert chosen("--input", None, signals, free) == 0
    for name in ("weather", "pump"):
        with pytest.raises(UserError, match=f"'{name}': expected one of heater"):
            chosen("--input", name, signals, free)
    with pytest.raises(UserError, match="heater; weather is a disturbance, which nobody sets"):
        chosen("--input", "weather", signals, free)
    both = Signal("heater"), Signal("flow")
    assert chosen("--input", "flow", both, [True, True]) == 1
    with pytest.raises(UserError, match="is missing: expected one of heater, flow"):
        chosen("--input", None, both, [True, True])
