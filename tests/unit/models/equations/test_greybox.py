"""The grey-box on simulated systems whose truth is known."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from asia.candidate import Context
from asia.data import Array, Trajectory
from asia.errors import UserError
from asia.models import greybox
from asia.models._equations.starts import (
    _ridge_weights,  # pyright: ignore[reportPrivateUsage]
)
from asia.models._least_squares import LevenbergMarquardt
from asia.problem import Bounds, ParameterRange, Physics
from tests.unit.models.systems.equations import (
    DUFFING,
    DUFFING_TRUTH,
    TANKS,
    context_for,
    duffing_record,
    held_steps,
    inverted,
    simulated,
)

NOISE = 0.01
METHOD = LevenbergMarquardt(iterations=40, starts=4)


def fitted(
    config: greybox.Config,
    trajectories: list[Trajectory],
    context: Context,
    method: LevenbergMarquardt = METHOD,
) -> greybox.GreyBox:
    return greybox.train(greybox.build(config, context), trajectories, context, method)


def split(record: Trajectory, n_past_u: int = 5, n_past_y: int = 5) -> tuple[Array, Array, Array]:
    """Past inputs, past outputs and future inputs of one case."""
    n = max(n_past_u, n_past_y)
    return record.u[None, n - n_past_u : n], record.y[None, n - n_past_y : n], record.u[None, n:]


def error(model: greybox.GreyBox, record: Trajectory) -> float:
    """Simulation RMSE over the samples after the past window."""
    y = model.simulate(*split(record))[0]
    return float(np.sqrt(np.mean((y - record.y[5:]) ** 2)))


@pytest.fixture(scope="module")
def duffing_context() -> Context:
    return context_for(DUFFING, "force", "y", 0.15, seed=3)


@pytest.fixture(scope="module")
def duffing(duffing_context: Context) -> greybox.GreyBox:
    records = [duffing_record(200, 0, NOISE), duffing_record(150, 1, NOISE)]
    return fitted(greybox.Config(), records, duffing_context)


def test_recovers_the_parameters_with_unknown_initial_states(duffing: greybox.GreyBox) -> None:
    found = duffing.parameters()
    assert found.keys() == DUFFING_TRUTH.keys()
    for name, value in DUFFING_TRUTH.items():
        assert found[name] == pytest.approx(value, rel=0.03)


def test_a_refit_starts_from_the_fold_models(duffing_context: Context) -> None:
    records = [duffing_record(200, 0, NOISE), duffing_record(150, 1, NOISE)]
    config, short = greybox.Config(residual=2), LevenbergMarquardt(iterations=1, starts=1)
    folds = [fitted(config, [record], duffing_context) for record in records]
    near = replace(duffing_context, fold_models=lambda: (*folds, folds[0].fitted))
    warm, cold = (fitted(config, records, context, short) for context in (near, duffing_context))
    assert warm.fitted is not None
    assert cold.fitted is not None
    assert warm.fitted.history[0] < 0.1 * cold.fitted.history[0]
    assert error(warm, duffing_record(80, 7, NOISE)) < 3 * NOISE
    # Models of another structure say nothing.
    other = replace(duffing_context, fold_models=lambda: (cold,))
    plain = [fitted(greybox.Config(), records, c, short) for c in (other, duffing_context)]
    assert plain[0].parameters() == plain[1].parameters()


@pytest.mark.slow
def test_simulates_a_new_record_from_its_past_window(duffing: greybox.GreyBox) -> None:
    record = duffing_record(80, 7, NOISE)
    assert error(duffing, record) < 3 * NOISE
    assert error(duffing, record) < 0.05 * record.y.std()


def test_a_case_does_not_depend_on_its_batch(duffing: greybox.GreyBox) -> None:
    cases = [split(duffing_record(80, seed)) for seed in (11, 12, 13)]
    together = duffing.simulate(*(np.concatenate(part) for part in zip(*cases, strict=True)))
    assert together.shape == (3, 75, 1)
    for i, case in enumerate(cases):
        np.testing.assert_allclose(together[i], duffing.simulate(*case)[0], rtol=1e-6, atol=1e-8)


def test_parameters_as_states_step_as_the_model_with_these_parameters(
    duffing: greybox.GreyBox,
) -> None:
    names = ("c", "k")
    changing = duffing.with_parameters(names)
    cases = [split(duffing_record(60, seed)) for seed in (11, 12)]
    past_u, past_y, u = (np.concatenate(part) for part in zip(*cases, strict=True))
    plain = duffing.initial(past_u, past_y, u[:, 0])
    state = changing.initial(past_u, past_y, u[:, 0])
    known = duffing.parameters()
    np.testing.assert_allclose(state[1], [[known[n] for n in names]] * 2)
    for k in range(20):
        plain, expected = duffing.step(plain, u[:, k])
        state, y = changing.step(state, u[:, k])
        np.testing.assert_allclose(y, expected, rtol=1e-12)
    # Each case has its own value; a stiffer second case moves differently from there on.
    chosen = state[1].copy()
    chosen[1, 1] *= 1.3
    changed, _ = changing.step((state[0], chosen), u[:, 20])
    same, _ = duffing.step(plain, u[:, 20])
    np.testing.assert_allclose(changed[0][0][0], same[0][0], rtol=1e-12)
    assert np.abs(changed[0][0][1] - same[0][1]).max() > 1e-4
    np.testing.assert_array_equal(changed[1], chosen)
    with pytest.raises(UserError, match="parameter 'mass' is unknown"):
        duffing.with_parameters(("mass",))


def test_stays_finite_far_outside_the_training_range(duffing: greybox.GreyBox) -> None:
    past_u, past_y, u = split(duffing_record(80, 5))
    assert np.isfinite(duffing.simulate(1e3 * past_u, 1e3 * past_y, 1e4 * u)).all()


def test_leaves_the_default_precision_alone(duffing: greybox.GreyBox) -> None:
    y = duffing.simulate(*split(duffing_record(80, 5)))
    assert y.dtype == np.float64
    assert jnp.ones(1).dtype == jnp.float32


def tank_record(samples: int, seed: int) -> Trajectory:
    """Two tanks of which the upper one overflows at 4 into the lower one, by half."""

    def rate(x: Array, u: Array) -> Array:
        x = np.maximum(x, 0.0)
        out = 0.3 * np.sqrt(x[0])
        inflow = 0.25 * u[0] - out
        over = max(inflow, 0.0) * np.clip(50.0 * (x[0] - 3.98), 0.0, 1.0)
        return np.array([inflow - over, out - 0.25 * np.sqrt(x[1]) + 0.5 * over])

    u = held_steps(samples, seed, 0.5, 4.5, hold=20)
    x = simulated(rate, u, np.array([2.0, 2.0]), 1.0)
    noise = np.random.default_rng(seed).normal(scale=NOISE, size=(samples, 1))
    return Trajectory(u, x[:, 1:] + noise, 1.0, "tanks")


@pytest.mark.slow
def test_finds_the_limit_and_the_spilled_fraction_of_a_full_tank() -> None:
    context = context_for(TANKS, "pump", "level", 1.0)
    record = tank_record(300, 4)
    plain = fitted(greybox.Config(), [record], context)
    config = greybox.Config(saturation=("x1",), spill=True)
    model = fitted(config, [record], context)
    assert model.parameters()["x1 limit"] == pytest.approx(4.0, rel=0.05)
    assert model.parameters()["x1 spilled fraction"] == pytest.approx(0.5, rel=0.15)
    assert error(model, tank_record(200, 5)) < 0.3 * error(plain, tank_record(200, 5))


@pytest.mark.long
def test_finds_an_input_delay() -> None:
    record = duffing_record(200, 0, NOISE)
    context = context_for(DUFFING, "force", "y", 0.15)
    delayed = Trajectory(np.roll(record.u, -2, axis=0)[:-2], record.y[:-2], 0.15)
    model = fitted(greybox.Config(input_delay=5.0, ridge=1e-6), [delayed], context)
    assert model.parameters()["force delay"] == pytest.approx(2.0, abs=0.2)


@pytest.mark.slow
def test_additions_explain_what_the_equations_lack(duffing_context: Context) -> None:
    """A constant force and a bias of the sensor, which the equations do not know."""
    record, new = (duffing_record(200, seed, NOISE) for seed in (0, 8))

    def biased(r: Trajectory) -> Trajectory:
        return Trajectory(r.u + 0.8, r.y + 0.5, r.sampling_time)

    plain = fitted(greybox.Config(), [biased(record)], duffing_context)
    config = greybox.Config(offset=("velocity", "y"), ridge=1e-6)
    model = fitted(config, [biased(record)], duffing_context)
    assert model.parameters()["y offset"] == pytest.approx(0.5, abs=0.05)
    assert error(model, biased(new)) < 0.2 * error(plain, biased(new))


def lag_record(seed: int) -> Trajectory:
    """Two first-order lags in a row; the input acts on the second one too."""
    u = held_steps(120, seed, -1.0, 1.0)
    x = simulated(
        lambda x, u: np.array([-0.8 * x[0] + u[0], -0.5 * x[1] + x[0] - 1.2 * u[0]]),
        u,
        np.zeros(2),
        0.3,
    )
    noise = np.random.default_rng(seed).normal(scale=NOISE, size=(120, 1))
    return Trajectory(u, x[:, 1:] + noise, 0.3)


@pytest.mark.long
def test_linear_term_finds_a_coupling_that_the_equations_lack() -> None:
    physics = Physics(
        ("x1", "x2"),
        {"x1": "-a*x1 + u", "x2": "-b*x2 + x1"},
        {"a": ParameterRange(0.1, 10.0), "b": ParameterRange(0.1, 10.0)},
        observation={"y": "x2"},
    )
    context = context_for(physics, "u", "y", 0.3)
    plain = fitted(greybox.Config(), [lag_record(0)], context)
    model = fitted(greybox.Config(linear=True, ridge=1e-6), [lag_record(0)], context)
    assert error(model, lag_record(1)) < 0.1 * error(plain, lag_record(1))
    assert error(model, lag_record(1)) < 4 * NOISE


@pytest.mark.long
def test_robust_loss_withstands_outliers(duffing_context: Context) -> None:
    record = duffing_record(200, 0, NOISE)
    spoiled = record.y.copy()
    spoiled[::17] += 8.0
    records = [Trajectory(record.u, spoiled, 0.15)]
    least_squares = fitted(greybox.Config(), records, duffing_context)
    robust = fitted(greybox.Config(robust=0.01), records, duffing_context)
    new = duffing_record(150, 7)
    assert error(robust, new) < 0.5 * error(least_squares, new)


KINEMATICS = Physics(
    states=("px", "py"),
    dynamics={"px": "v*cos(heading)", "py": "v*sin(heading)"},
    observation={"east": "px", "north": "py"},
    constants={"gain": 1.0},
)


@pytest.mark.parametrize(("n_past_u", "n_past_y"), [(0, 1), (1, 3)])
@pytest.mark.slow
def test_known_kinematics_with_two_inputs_and_outputs(n_past_u: int, n_past_y: int) -> None:
    context = context_for(
        KINEMATICS, "v heading", "east north", 0.1, n_past_u=n_past_u, n_past_y=n_past_y
    )
    rng = np.random.default_rng(0)
    u = np.column_stack([np.full(40, 1.0), np.cumsum(rng.normal(scale=0.1, size=40))])
    steps = 0.1 * np.column_stack([u[:, 0] * np.cos(u[:, 1]), u[:, 0] * np.sin(u[:, 1])])
    y = np.vstack([np.zeros(2), np.cumsum(steps, axis=0)[:-1]])
    records = [Trajectory(u, y, 0.1), Trajectory(u[:30], y[:30], 0.1)]
    model = fitted(greybox.Config(), records, context, LevenbergMarquardt(iterations=5))
    assert model.parameters() == {}
    y_hat = model.simulate(*split(records[0], n_past_u, n_past_y))[0]
    n_past = max(n_past_u, n_past_y)
    assert y_hat.shape == (40 - n_past, 2)
    if n_past_y:
        np.testing.assert_allclose(y_hat, y[n_past:], atol=2e-2)


def first_error(model: greybox.GreyBox, n_past_u: int, n_past_y: int) -> float:
    """RMSE of the first simulated sample over the starts in a new record."""
    noisy, clean = duffing_record(300, 7, NOISE), duffing_record(300, 7)
    starts = np.arange(12, 270)
    y = model.simulate(
        np.stack([noisy.u[k - n_past_u : k] for k in starts]),
        np.stack([noisy.y[k - n_past_y : k] for k in starts]),
        noisy.u[starts, None],
    )
    return float(np.sqrt(np.mean((y[:, 0] - clean.y[starts]) ** 2)))


# Without past inputs the velocity comes from the noisy outputs alone, and the input that acts up to
# the first sample is a guess: at every change of the staircase it is wrong.
@pytest.mark.parametrize(("n_past_u", "n_past_y", "times"), [(0, 5, 7.0), (3, 12, 2.0)])
@pytest.mark.slow
def test_start_state_is_found_from_more_past_outputs_than_inputs(
    n_past_u: int, n_past_y: int, times: float, duffing: greybox.GreyBox, duffing_context: Context
) -> None:
    context = replace(duffing_context, n_past_u=n_past_u, n_past_y=n_past_y)
    records = [duffing_record(200, 0, NOISE), duffing_record(150, 1, NOISE)]
    quick = LevenbergMarquardt(iterations=12, starts=2)
    model = fitted(greybox.Config(), records, context, quick)
    assert first_error(model, n_past_u, n_past_y) < times * first_error(duffing, 5, 5)


@pytest.mark.long
def test_the_unit_of_the_output_does_not_matter() -> None:
    u = held_steps(150, 0, -1.0, 1.0)
    truth = simulated(lambda x, v: np.array([x[1], v[0] - 0.5 * x[1] - 2.0 * x[0]]), u, [1, 0], 0.2)

    def found(unit: float) -> Array:
        physics = Physics(
            states=("x", "v"),
            parameters={
                "c": ParameterRange(0.05, 5.0),
                "k": ParameterRange(0.1, 20.0),
                "b": ParameterRange(0.1 * unit, 10.0 * unit),
            },
            dynamics={"x": "v", "v": "-c*v - k*x + b*force"},
            observation={"y": "x"},
        )
        record = Trajectory(u, unit * truth[:, :1], 0.2)
        context = context_for(physics, "force", "y", 0.2)
        model = fitted(greybox.Config(), [record], context, LevenbergMarquardt(15, starts=2))
        return model.simulate(*split(record))[0] / unit

    plain = found(1.0)
    np.testing.assert_allclose(plain, truth[5:, :1], atol=1e-3)
    for unit in (1e-10, 1e10):
        np.testing.assert_allclose(found(unit), plain, atol=1e-3)


@pytest.mark.slow
def test_with_a_horizon_it_learns_from_windows(duffing_context: Context) -> None:
    context = replace(duffing_context, horizon=30)
    records = [duffing_record(140, 0, NOISE), duffing_record(100, 1, NOISE)]
    model = fitted(greybox.Config(), records, context)
    for name, value in DUFFING_TRUTH.items():
        assert model.parameters()[name] == pytest.approx(value, rel=0.05)


def test_bounds_hold_in_the_simulation(duffing_context: Context) -> None:
    physics = Physics(("x",), {"x": "u"}, bounds={"x": Bounds(0.0, 1.0)}, observation={"y": "x"})
    context = context_for(physics, "u", "y", 1.0, n_past_u=1, n_past_y=1)
    u = held_steps(60, 0, -1.0, 1.0)
    y = np.clip(np.concatenate([[[0.0]], np.cumsum(u[:-1], axis=0)]), 0.0, 1.0)
    model = fitted(greybox.Config(), [Trajectory(u, y, 1.0)], context)
    y_hat = model.simulate(u[None, :1], y[None, :1], np.ones((1, 5, 1)))
    assert y_hat.max() == 1.0
    assert model.simulate(u[None, :1], y[None, :1], -np.ones((1, 5, 1))).min() == 0.0


@pytest.mark.parametrize(
    "arguments",
    [
        {"spill": True},
        {"residual": -1},
        {"input_delay": -1.0},
        {"ridge": -1.0},
        {"residual_ridge": -1.0},
        {"substeps": 0},
        {"robust": 0.0},
    ],
)
def test_settings_out_of_range_are_refused(arguments: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=r"greybox\.Config"):
        greybox.Config(**arguments)


@pytest.mark.parametrize(
    "config",
    [greybox.Config(saturation=("speed",)), greybox.Config(offset=("speed",))],
)
def test_names_that_are_not_in_the_physics_are_refused(
    config: greybox.Config, duffing_context: Context
) -> None:
    with pytest.raises(ValueError, match="'speed', known are position, velocity"):
        greybox.build(config, duffing_context)


def test_a_problem_without_physics_is_refused() -> None:
    with pytest.raises(ValueError, match="no \\[physics\\]"):
        greybox.build(greybox.Config(), context_for(None, "force", "y", 0.15))


def test_physics_that_do_not_fit_the_signals_are_refused() -> None:
    with pytest.raises(UserError, match="undefined symbol 'force'"):
        greybox.build(greybox.Config(), context_for(DUFFING, "torque", "y", 0.15))


def test_use_before_training_and_wrong_past_windows_are_refused(
    duffing: greybox.GreyBox, duffing_context: Context
) -> None:
    past_u, past_y, u = split(duffing_record(80, 5))
    with pytest.raises(ValueError, match="not trained"):
        greybox.build(greybox.Config(), duffing_context).simulate(past_u, past_y, u)
    with pytest.raises(ValueError, match="past windows of 4 and 5 samples"):
        duffing.simulate(past_u[:, :4], past_y, u)


def test_measured_states_start_the_windows_of_an_unstable_system() -> None:
    physics = Physics(
        states=("angle", "rate"),
        parameters={"k": ParameterRange(0.1, 10.0), "b": ParameterRange(0.1, 10.0)},
        dynamics={"angle": "rate", "rate": "k*angle + b*torque"},
    )
    context = context_for(physics, "torque", "angle rate", 0.05, n_past_u=1, n_past_y=1, horizon=10)
    model = greybox.build(greybox.Config(substeps=1), context)
    assert model.structure.states_measured
    run = inverted(120, 0)
    model = greybox.train(model, [run], context, LevenbergMarquardt(iterations=15))
    assert model.parameters() == pytest.approx({"k": 2.0, "b": 3.0}, rel=1e-2)
    y = model.simulate(run.u[None, 4:5], run.y[None, 4:5], run.u[None, 5:15])
    np.testing.assert_allclose(y[0], run.y[5:15], atol=0.02 * np.abs(run.y[5:15]).max())


def test_measured_start_needs_every_state_in_the_past_window() -> None:
    with pytest.raises(UserError, match="does not show every state"):
        greybox.build(greybox.Config(initial="measured"), context_for(DUFFING, "force", "y", 0.15))


def test_rounding_does_not_move_the_initial_state() -> None:
    """A printed program rounds otherwise than NumPy; the last step needs no comparison of costs."""
    physics = Physics(
        states=("h",),
        parameters={"b": ParameterRange(1e-3, 1.0), "a": ParameterRange(1e-3, 1.0)},
        dynamics={"h": "b*u - a*sqrt(h)"},
        observation={"y": "h"},
    )
    context = context_for(physics, "u", "y", 2.0)
    u = held_steps(600, 3, 0.5, 4.0)
    rng = np.random.default_rng(4)
    x = simulated(
        lambda x, u: 0.05 * u - 0.06 * np.sqrt(np.maximum(x, 0.0)), u, np.array([4.0]), 2.0
    )
    y = x + 0.02 * rng.normal(size=x.shape)
    record = Trajectory(u, y, 2.0, "")
    method = LevenbergMarquardt(iterations=20, starts=2)
    model = greybox.train(greybox.build(greybox.Config(), context), [record], context, method)
    places = np.arange(0, 500)
    n_u, n_y = context.n_past_u, context.n_past_y
    past_u = np.stack([u[k : k + n_u] for k in places])
    past_y = np.stack([y[k : k + n_y] for k in places])
    after = np.stack([u[k + n_u : k + n_u + 1] for k in places])
    plain = model.simulate(past_u, past_y, after)
    rounded = past_y * (1.0 + 4e-16 * rng.choice([-1.0, 1.0], size=past_y.shape))
    other = model.simulate(past_u, rounded, after)
    assert np.abs(plain - other).max() < 2e-11 * y.std()


def test_a_past_window_shows_the_speed_in_the_small_differences_of_its_outputs() -> None:
    random = np.random.default_rng(0)
    time = np.arange(4_000)[:, None]
    rates, phases = random.uniform(1e-3, 4e-3, 8), random.uniform(0.0, 6.0, 8)
    position = np.sin(rates * time + phases).sum(axis=1)
    speed = (rates * np.cos(rates * time + phases)).sum(axis=1)
    windows = np.lib.stride_tricks.sliding_window_view(position, 20)
    phi = np.column_stack([np.ones(len(windows)), windows + 1e-6 * random.normal(size=(1, 20))])
    target = np.column_stack([speed[: len(windows)], random.normal(size=len(windows))])
    weights, error = _ridge_weights(phi, target)
    left = target - phi @ weights
    assert error == pytest.approx(left.std(axis=0), rel=0.02)
    assert left[:, 0].std() < 0.02 * speed.std()
    assert left[:, 1].std() == pytest.approx(1.0, abs=0.05)


def test_few_past_windows_do_not_make_the_initial_state_look_certain() -> None:
    random = np.random.default_rng(1)
    phi, truth = random.normal(size=(440, 46)), random.normal(size=(46, 1))
    target = phi @ truth + random.normal(size=(440, 1))
    weights, error = _ridge_weights(phi[:40], target[:40])
    assert error[0] > 0.3 * (target - phi @ weights)[40:].std()
