"""Linear plants from closed-loop records."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import signal

from asia.candidate import Context
from asia.data import Signal, Trajectory
from asia.data.trajectory import Array
from asia.errors import UserError
from asia.models import linear
from asia.models._linear.closed_loop import LoopMethod
from asia.problem.feedback import Controller, Loop, explained_inputs

PI = Controller((0.9, -0.75), (1.0, -1.0))
LOOP = Loop(reference=(Signal("r"),), controller=PI)
CONTEXT = Context((Signal("u"),), (Signal("y"),), 1.0, 10, 10, loop=LOOP)


def record(
    pole: float, seed: int, *, enters: str = "controller", samples: int = 1500
) -> Trajectory:
    """y[k] = pole y[k-1] + (1 - 0.8) u[k-1] + coloured noise, u = PI (r - y) or r - PI y, around an
    operating point at y = 5."""
    rng = np.random.default_rng(seed)
    r = np.repeat(rng.choice([-1.0, 1.0], samples // 10 + 1), 10)[:samples]
    noise = signal.lfilter([1.0], [1.0, -0.9], 0.25 * rng.standard_normal(samples))
    level = 5.0 if enters == "controller" else 0.0
    x = level
    integral = level * (1.0 - pole) / 0.2
    u, y = np.empty(samples), np.empty(samples)
    for k in range(samples):
        y[k] = x + noise[k]
        e = r[k] + level - y[k] if enters == "controller" else -y[k]
        u[k] = integral + 0.9 * e + (r[k] if enters == "plant" else 0.0)
        integral += 0.15 * e
        x = pole * x + 0.2 * u[k]
    return Trajectory(u, y, 1.0, reference=(r + level)[:, None])


def plant_error(model: linear.LinearStateSpace, pole: float) -> float:
    """Relative error of the frequency response between a hundredth of Nyquist and Nyquist."""
    assert model.fitted is not None
    s, scaling = model.fitted.system, model.fitted.scaling
    z = np.exp(1j * np.pi * np.geomspace(0.01, 0.5, 60))
    late = z**-model.fitted.delay
    found = np.array([
        (s.c @ np.linalg.solve(one * np.eye(s.order) - s.a, s.b) + s.d)[0, 0] for one in z
    ])  # fmt: skip
    found *= late * scaling.y_std[0] / scaling.u_std[0]
    truth = 0.2 / (z - pole)
    return float(np.sqrt((abs(found - truth) ** 2).mean() / (abs(truth) ** 2).mean()))


def fitted(
    record: Trajectory, loop: LoopMethod | None, context: Context = CONTEXT
) -> linear.LinearStateSpace:
    config = linear.Config(loop=loop, order=2)
    model = linear.train(linear.build(config, context), [record], context)
    if loop == "direct":
        # A predictor cannot tell a plant without delay from a controller that answers at once.
        assert model.fitted is not None
        assert model.fitted.delay >= 1
    return model


@pytest.mark.slow
@pytest.mark.parametrize(
    "method", ["direct", "controller", pytest.param("two_stage", marks=pytest.mark.long)]
)
def test_feedback_of_noise_biases_the_open_loop_fit_only(method: LoopMethod) -> None:
    measured = record(0.8, 0, samples=900)
    biased = plant_error(fitted(measured, None), 0.8)
    assert biased > 0.15
    assert plant_error(fitted(measured, method), 0.8) < 0.6 * biased


@pytest.mark.slow
@pytest.mark.parametrize(
    ("pole", "method"),
    [
        pytest.param(1.0, "direct", marks=pytest.mark.long),
        (1.0, "two_stage"),
        (1.05, "direct"),
        pytest.param(1.05, "controller", marks=pytest.mark.long),
        pytest.param(1.0, "controller", marks=pytest.mark.long),
        pytest.param(1.05, "two_stage", marks=pytest.mark.long),
    ],
)
def test_a_plant_that_integrates_or_is_unstable(pole: float, method: LoopMethod) -> None:
    model = fitted(record(pole, 0, samples=900), method)
    assert model.fitted is not None
    assert abs(abs(np.linalg.eigvals(model.fitted.system.a)).max() - pole) < 0.02
    # From the past window on, the operating point included.
    new = record(pole, 7, samples=900)
    starts = np.arange(20, 880, 30)
    past_u, past_y, u, y = (
        np.stack([values[s + a : s + b] for s in starts])
        for values, a, b in ((new.u, -10, 0), (new.y, -10, 0), (new.u, 0, 10), (new.y, 0, 10))
    )
    error = model.simulate(past_u, past_y, u) - y
    assert np.sqrt((error**2).mean()) < 0.75 * new.y.std()
    state, steps = model.initial(past_u, past_y, u[:, 0]), list[Array]()
    for k in range(10):
        state, one = model.step(state, u[:, k])
        steps.append(one)
    np.testing.assert_allclose(
        np.stack(steps, axis=1), model.simulate(past_u, past_y, u), rtol=1e-9, atol=1e-9
    )


@pytest.mark.long
def test_a_reference_that_enters_at_the_plant() -> None:
    context = replace(CONTEXT, loop=replace(LOOP, enters="plant"))
    measured = record(0.8, 0, enters="plant")
    assert plant_error(fitted(measured, "controller", context), 0.8) < 0.12
    # The same record with the reference taken for a setpoint is another loop.
    assert plant_error(fitted(measured, "controller"), 0.8) > 0.3


@pytest.mark.long
def test_a_delay_is_found_and_lies_in_the_loop() -> None:
    rng = np.random.default_rng(0)
    r = np.repeat(rng.choice([-1.0, 1.0], 80), 10)
    noise = 0.2 * rng.standard_normal(800)
    control = 0.3
    u, y, x = np.zeros(800), np.zeros(800), 0.0
    for k in range(800):
        y[k] = x + noise[k]
        u[k] = control * (r[k] - y[k])
        x = 0.9 * x + 0.5 * (u[k - 3] if k >= 3 else 0.0)
    loop = replace(LOOP, controller=Controller((control,), (1.0,)))
    context = replace(CONTEXT, loop=loop)
    config = linear.Config(loop="controller", delay=None, order=1)
    measured = Trajectory(u, y, 1.0, reference=r[:, None])
    model = linear.train(linear.build(config, context), [measured], context)
    assert model.fitted is not None
    # Four samples; a state of the plant may be one of them.
    assert model.fitted.delay in (3, 4)
    assert abs(model.fitted.system.a[0, 0] - 0.9) < 0.02


@pytest.mark.long
def test_explained_inputs_remove_the_bias_of_every_family() -> None:
    errors = list[tuple[float, float]]()
    for seed in range(2):
        measured = record(0.8, seed, samples=900)
        clean = replace(measured, u=explained_inputs([measured])[0])
        errors.append(
            (plant_error(fitted(measured, None), 0.8), plant_error(fitted(clean, None), 0.8))
        )
    biased, unbiased = np.mean(errors, axis=0)
    assert unbiased < 0.6 * biased


def test_what_a_method_lacks_is_said() -> None:
    measured = record(0.8, 0, samples=300)
    without = replace(measured, reference=None)
    for method in ("two_stage", "controller"):
        with pytest.raises(UserError, match="measured reference"):
            fitted(without, method, replace(CONTEXT, loop=None))
    with pytest.raises(UserError, match="needs \\[loop\\] controller"):
        fitted(measured, "controller", replace(CONTEXT, loop=replace(LOOP, controller=None)))
    still = replace(measured, reference=np.ones((300, 1)))
    with pytest.raises(UserError, match="constant"):
        fitted(still, "two_stage")
    wrong = replace(LOOP, controller=Controller((-5.0,), (1.0,)))
    with pytest.raises(UserError, match="no start is stable"):
        fitted(measured, "controller", replace(CONTEXT, loop=wrong))
    with pytest.raises(UserError, match="inputs = 'explained'"):
        fitted(measured, "direct", replace(CONTEXT, loop=replace(LOOP, inputs="explained")))
    with pytest.raises(UserError, match="loop"):
        linear.Config(loop="direct", integrators=1)
    # Without a reference the direct method still applies.
    assert plant_error(fitted(without, "direct", replace(CONTEXT, loop=None)), 0.8) < 0.5
