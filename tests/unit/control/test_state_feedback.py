"""LQR and predictive control: offset, optimality within limits, margins, code."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import control
import numpy as np
import pytest
from scipy.optimize import minimize

from asia.control.design import (
    Limits,
    Loop,
    SampledController,
    SimulatedDesign,
    Specification,
    Transfer,
    design_in_simulation,
    response_figures,
    simulate_loop,
    zero_order_hold,
)
from asia.control.state_feedback import PredictiveController, state_feedback_designer
from asia.errors import UserError
from asia.lowering.linear import LinearModel
from tests.unit.control.test_control_command import c_step, matrix_step, python_step, st_step
from tests.unit.interfaces.cli.conftest import command_line

WANTED = Specification(2.0, 45.0, None, 8.0, 10.0, 1e-3)
LAGS = Transfer(np.array([2.0]), np.array([1.0, 1.2, 1.0]), 0.13)
RESONANCE = Transfer(np.array([1.0]), np.array([1.0, 0.1, 1.0]), 0.1)


def designed(
    plant: Transfer, kind: str, *, limits: Limits = Limits(),  # noqa: B008
    weight: float | None = 0.3, time: float = 0.2, moves: int | None = None,
) -> SimulatedDesign:  # fmt: skip
    weights = None if weight is None else (1.0, weight)
    designer = state_feedback_designer(
        limits, predictive=kind == "mpc", weights=weights, moves=moves
    )
    return design_in_simulation(Loop("plant", ("loop",), [plant], [], time), WANTED, designer)


@pytest.mark.parametrize("kind", ["lqr", "mpc"])
def test_the_set_point_is_held_on_another_plant_with_a_load(kind: str) -> None:
    controller = designed(LAGS, kind, limits=Limits(-1.0, 3.0)).controller
    other = Transfer(np.array([2.6]), np.array([1.3, 1.2, 1.0]), 0.2)
    (step,), starts = (plant := zero_order_hold(other, 0.2)).steps, plant.starts
    loaded = type(plant)("loaded", [lambda x, u: step(x, u - 0.7)], starts)
    y, u = simulate_loop(controller, loaded, np.ones(300))
    found = response_figures(y, u, controller, 1.0)
    assert found.error < 1e-3
    assert u[-1] == pytest.approx(1 / 2.6 + 0.7, abs=1e-3)
    assert (u >= -1.0).all()
    assert (u <= 3.0).all()


def test_figures_agree_with_python_control() -> None:
    made = designed(LAGS, "lqr")
    one, figures = made.controller, made.figures[0]
    own = made.loop.models[0]
    plant = control.ss(own.a, own.b, own.c, own.d, 0.2)
    into = one.b[:, 1:2] + one.b[:, 2:] * one.d[1]
    back = control.ss(one.a + one.b[:, 2:] @ one.c[None], into, one.c[None], [[one.d[1]]], 0.2)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        gain, phase, *_ = control.margin(-plant * back)
    assert figures.gain_margin == pytest.approx(gain, rel=0.02)
    assert figures.phase_margin == pytest.approx(phase, abs=0.5)
    # The simulation without limits is the step response that the figures describe.
    assert made.judged[0].settling == pytest.approx(figures.settling, abs=0.21)
    assert made.judged[0].overshoot == pytest.approx(figures.overshoot, abs=1e-6)


def test_a_search_for_weights_meets_the_specifications() -> None:
    made = designed(LAGS, "lqr", weight=None)
    assert made.design.violated == ()
    assert made.missed == []
    assert made.figures[0].gain_margin >= 2.0
    assert made.figures[0].phase_margin >= 45.0
    assert made.judged[0].settling <= 8.0


def test_a_load_is_compensated_in_time() -> None:
    made = designed(LAGS, "lqr", weight=None)
    (step,), starts = (plant := zero_order_hold(LAGS, 0.2)).steps, plant.starts
    loaded = type(plant)("loaded", [lambda x, u: step(x, u + 0.5)], starts)
    y, _ = simulate_loop(made.controller, loaded, np.zeros(200))
    settled = 0.2 * (int(np.flatnonzero(np.abs(y) > 0.02)[-1]) + 1)
    assert settled == pytest.approx(made.figures[0].load_settling, abs=0.21)
    assert settled <= 16.0
    late = replace(made.figures[0], load_settling=17.0)
    assert [name for name, _ in late.violations(WANTED)] == ["settling after a load"]


def test_a_predictive_controller_without_active_limits_is_the_lqr() -> None:
    lqr, mpc = (designed(LAGS, kind, limits=Limits(-90.0, 90.0, 900.0)) for kind in ("lqr", "mpc"))
    assert isinstance(mpc.controller, PredictiveController)
    for one, other in zip(lqr.responses[0], mpc.responses[0], strict=True):
        assert one == pytest.approx(other, abs=1e-9)


def test_a_plan_is_optimal_within_the_limits() -> None:
    one = designed(LAGS, "mpc", limits=Limits(-0.4, 0.9, 1.5), moves=8).controller
    assert isinstance(one, PredictiveController)
    rng, active = np.random.default_rng(0), 0
    for _ in range(20):
        x, last, y = rng.normal(size=len(one.c)), rng.uniform(-0.4, 0.9), rng.normal()
        plan = one.plan @ np.concatenate([x, [1.0, y]])
        found = minimize(
            lambda v, plan=plan: 0.5 * float(((one.root @ (v - plan)) ** 2).sum()),
            np.full(8, last), jac=lambda v, plan=plan: one.root.T @ (one.root @ (v - plan)),
            bounds=[(-0.4, 0.9)] * 8, method="SLSQP", options={"ftol": 1e-14, "maxiter": 500},
            constraints={
                "type": "ineq",
                "fun": lambda v, last=last: 0.3 - np.abs(np.diff(v, prepend=last)),
            },
        )  # fmt: skip
        code = one.started()
        code.x, code.last = x, last
        u = code.step(1.0, y)
        assert u == pytest.approx(found.x[0], abs=1e-4)
        active += abs(u - plan[0]) > 1e-3
    assert active >= 5


def test_a_predictive_controller_plans_with_the_rate() -> None:
    # The LQR does not know the rate of the input and oscillates.
    lqr, mpc = (
        designed(RESONANCE, kind, limits=Limits(0.0, 1.5, 0.5), weight=0.08, time=0.08)
        for kind in ("lqr", "mpc")
    )
    assert lqr.missed
    assert mpc.missed == []
    _, u = mpc.responses[0]
    assert np.abs(np.diff(u, prepend=0.0)).max() == pytest.approx(0.04)
    assert (u >= 0.0).all()


def test_a_plant_without_static_gain_is_refused() -> None:
    with pytest.raises(UserError, match="does not move the output"):
        designed(Transfer(np.array([1.0, 0.0]), np.array([1.0, 2.0, 1.0])), "lqr")


@pytest.mark.parametrize("kind", ["lqr", "mpc"])
def test_an_output_that_has_the_input_of_its_own_sample_is_controlled(kind: str) -> None:
    made = designed(Transfer(np.array([1.0, 2.0]), np.array([1.0, 1.0])), kind)
    assert made.missed == []
    one, other = made.figures[0], made.judged[0]
    assert one.settling == pytest.approx(other.settling)
    assert one.overshoot == pytest.approx(other.overshoot, abs=1e-9)


@pytest.mark.parametrize(
    ("made", "kind"),
    [(python_step, "lqr"), (c_step, "lqr"), (st_step, "lqr"), (python_step, "mpc")],
)
def test_code_gives_the_inputs_of_the_simulation(
    made: Callable[[Path, SampledController], Callable[[float, float], float]],
    kind: str,
    tmp_path: Path,
) -> None:
    model = LinearModel(
        np.array([[0.9, 0.2], [-0.1, 0.7]]), np.array([[0.1], [0.5]]), np.array([[1.0, 0.0]]),
        np.zeros((1, 1)), 0.05, np.zeros(1), np.zeros(1),
    )  # fmt: skip
    plant = zero_order_hold(LAGS, 0.05)
    loop = Loop("run", ("loop",), [], [plant], 0.05, 2.0, -1.5, 0.0, models=[model])
    designer = state_feedback_designer(
        Limits(0.0, 4.5, 30.0), predictive=kind == "mpc", weights=(1.0, 0.1)
    )
    code = design_in_simulation(loop, WANTED, designer).controller
    step = made(tmp_path, code)
    known = code.started().step if kind == "mpc" else matrix_step(code)
    seen: list[float] = []
    for r, y in np.random.default_rng(0).normal(-1.5, 1.0, (200, 2)):
        seen.append(known(float(r), float(y)))
        assert step(float(r), float(y)) == pytest.approx(seen[-1], abs=1e-9)
    assert np.std(seen) > 1e-3
    started = code.started(1.0)
    assert [started.step(-1.5, -1.5) for _ in range(30)] == pytest.approx([1.0] * 30, abs=1e-6)


def test_the_command_designs_and_writes_them(tmp_path: Path) -> None:
    words = ("control", "--plant", "2/(s^2+1.2*s+1)", "--settling", "8", "--kind")
    shown = command_line(*words, "lqr", "--out", tmp_path / "lqr")
    assert shown.code == 0, shown.err
    assert "structure LQR with an observer of" in shown.out
    assert "controller_step" in (tmp_path / "lqr" / "controller.c").read_text("utf-8")
    more = ("--weights", "y=2,u=0.6", "--moves", "12", "--limits", "u=0..1.4", "--json")
    found = json.loads(command_line(*words, "mpc", *more, "--out", tmp_path / "mpc").out)
    assert found["structure"].startswith("MPC of 12 moves")
    assert found["weights"] == [1.0, 0.3]
    assert found["missed_in_simulation"] == []
    assert not (tmp_path / "mpc" / "controller.c").exists()
    assert "expected pid, lqr, mpc" in command_line(*words, "h2").err
    assert "such as y=1,u=0.1" in command_line(*words, "lqr", "--weights", "v=1").err
    assert "are for --kind lqr and mpc" in command_line(*words[:-1], "--moves", "3").err
