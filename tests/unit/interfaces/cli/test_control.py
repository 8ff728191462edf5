"""asia control: controllers that python-control finds to meet the specifications."""

from __future__ import annotations

import json
import warnings

import control
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from asia.analysis.control import Specification, Transfer, design, loop_figures
from asia.errors import UserError
from asia.interfaces.cli.control import pid_gains, rational
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


def test_an_impossible_specification_is_named() -> None:
    # A right half plane zero at 1 rad/s forbids a settling time of 0.1 s without overshoot.
    num, den = rational("(1-s)/(s^2+2*s+1)")
    wanted = Specification(3.0, 60.0, None, 0.1, 1.0, 1e-3)
    found = design([Transfer(num, den)], wanted, effort=3)
    assert found.violated


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
