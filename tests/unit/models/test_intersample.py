"""Inputs between samples: weights, simulation, steps, derivatives and the choice for each input."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from scipy.signal import lsim

from asia.candidate import Context, simulate_steps
from asia.data.statistics import at_once, staircases, undecided_inputs
from asia.data.trajectory import Array, Intersample, Signal, Trajectory
from asia.errors import UserError
from asia.lowering.derivatives import derivatives
from asia.lowering.evaluation import simulate
from asia.models import compartments, greybox, hybrid, simulator
from asia.models._numerics.intersample import Between, between, inputs_of, interpolation
from asia.models.methods import LevenbergMarquardt
from asia.problem.physics import ParameterRange, Physics
from asia.problem.plant import Plant, Unknown
from asia.recipe import Recipe
from tests.unit.export.models import PAST, grey_box, lowered_model, ready

KINDS: tuple[Intersample, ...] = ("zero", "first", "band_limited")
STEP = 0.25
OSCILLATOR = Physics(
    states=("x", "v"),
    dynamics={"x": "v", "v": "gain*u - 0.4*v - stiffness*x"},
    parameters={"gain": ParameterRange(1.0, 20.0), "stiffness": ParameterRange(2.0, 30.0)},
    observation={"y": "x"},
)
CONTEXT = Context((Signal("u"),), (Signal("y"),), STEP, 4, 4, physics=OSCILLATOR, seed=1)
METHOD = LevenbergMarquardt(iterations=20, starts=2)


def record(seed: int, samples: int = 240) -> Trajectory:
    """Oscillator of ten samples a period, driven by an input that is linear between samples."""
    u = np.random.default_rng(seed).normal(size=samples)
    a, b = np.array([[0.0, 1.0], [-6.0, -0.4]]), np.array([[0.0], [5.0]])
    system = a, b, np.array([[1.0, 0.0]]), np.zeros((1, 1))
    _, y, _ = lsim(system, u, STEP * np.arange(samples), interp=True)
    return Trajectory(u[:, None], y[:, None], STEP, f"r{seed}")


def fitted(kind: Intersample | None, context: Context = CONTEXT) -> greybox.GreyBox:
    model = greybox.build(greybox.Config(substeps=4, intersample=kind), context)
    return greybox.train(model, [record(0)], context, METHOD)


def error(model: greybox.GreyBox, new: Trajectory) -> float:
    y = model.simulate(new.u[None, :4], new.y[None, :4], new.u[None, 4:])[0]
    return float(np.sqrt(((y - new.y[4:]) ** 2).mean()) / new.y.std())


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("memory", [1, 7, 9])
def test_an_interpolation_goes_through_the_samples_and_keeps_a_constant(
    kind: Intersample, memory: int
) -> None:
    if Between((kind,)).memory > memory:
        return
    weights = interpolation(kind, np.linspace(0.0, 1.0, 9), memory)
    assert weights.sum(axis=-1) == pytest.approx(1.0)
    ends = np.eye(memory + 1)[[-2, -2 if kind == "zero" else -1]]
    assert weights[[0, -1]] == pytest.approx(ends, abs=1e-9)


def multisine(highest: float, samples: int = 2_000) -> tuple[Array, Array]:
    """Signal with lines up to a frequency per sample, at the samples and at quarters of them."""
    random = np.random.default_rng(0)
    lines = np.arange(1, int(highest * samples)) / samples
    phases = random.uniform(0.0, 2.0 * np.pi, len(lines))
    fine = np.cos(2.0 * np.pi * np.arange(4 * samples)[:, None] / 4 * lines + phases).sum(axis=1)
    return fine[::4], fine


@pytest.mark.parametrize(("highest", "most"), [(0.1, 0.002), (0.33, 0.03)])
def test_the_curve_follows_an_input_by_the_spectrum_of_its_records(
    highest: float, most: float
) -> None:
    u, fine = multisine(highest)
    record = Trajectory(u[:, None], u[:, None], 1.0, "r")
    acting = between((Signal("u"),), [record], "band_limited")
    errors: dict[str, float] = {}
    for kind, one in (("line", Between(("first",))), ("curve", acting)):
        windows = np.moveaxis(one.windows(u[:, None]), 0, -1)
        found = one.stages(windows, 2)[:, 1, 0]  # the middles of both halves
        wrong = np.stack([found[0] - fine[1::4], found[1] - fine[3::4]])[:, 10:-10]
        errors[kind] = float(wrong.std() / u.std())
    assert errors["curve"] < most
    assert errors["curve"] < 0.2 * errors["line"]


def test_windows_end_with_the_sample_after_and_hold_the_ends() -> None:
    u = np.arange(5.0)[:, None]
    assert Between(("zero",)).windows(u)[:, :, 0].tolist() == [[0.0], [1.0], [2.0], [3.0], [4.0]]
    found = Between(("first",)).windows(u)[:, :, 0]
    assert found.tolist() == [[0.0, 1.0], [1.0, 2.0], [2.0, 3.0], [3.0, 4.0], [4.0, 4.0]]
    assert Between(("band_limited",)).windows(u)[0, :, 0].tolist() == [0.0] * 7 + [1.0]


def test_a_linear_input_is_integrated_as_such_and_the_parameters_are_found() -> None:
    new = record(1)
    held, linear = fitted("zero"), fitted("first")
    assert error(held, new) > 0.1
    assert error(linear, new) < 2e-3
    assert linear.parameters() == pytest.approx({"gain": 5.0, "stiffness": 6.0}, rel=2e-3)
    assert "u is linear between samples" in linear.equations()
    assert not any("between samples" in line for line in held.equations())


def test_without_a_choice_inputs_are_held_and_the_problem_file_decides() -> None:
    assert fitted(None).structure.intersample is None
    stated = replace(CONTEXT, inputs=(Signal("u", intersample="first"),))
    assert fitted("zero", stated).structure.intersample == Between(("first",))


@pytest.mark.parametrize("kinds", [("first", "zero"), ("zero", "band_limited")])
def test_steps_simulate_as_the_whole_and_read_no_later_input(
    kinds: tuple[Intersample, ...],
) -> None:
    model, random = grey_box(*kinds), np.random.default_rng(0)
    past_u, past_y, u = (random.normal(size=(3, n, 2)) for n in (PAST, PAST, 20))
    y = model.simulate(past_u, past_y, u)
    assert simulate_steps(model, past_u, past_y, u) == pytest.approx(y, abs=1e-10)
    later = u.copy()
    later[:, 12:] += 1.0
    assert np.array_equal(model.simulate(past_u, past_y, later)[:, :12], y[:, :12])
    held = grey_box().simulate(past_u, past_y, u)
    assert np.abs(held - y).max() > 1e-3


@pytest.mark.parametrize("kinds", [(), ("first", "zero"), ("band_limited", "first")])
def test_an_exported_program_has_the_values_and_the_derivatives_of_the_steps(
    kinds: tuple[Intersample, ...],
) -> None:
    with jax.enable_x64(True):
        model = grey_box(*kinds)
        low = lowered_model(model)
        window = ready(model, low).windows[0]
        found = simulate(low, window.past_u, window.past_y, window.u)
        assert found == pytest.approx(window.y_hat, abs=1e-9)
        state = model.initial(window.past_u[None], window.past_y[None], window.u[:1])
        inside = [np.asarray(part)[0] for part in jax.tree.leaves(state) if np.size(part)]
        _, slopes = derivatives(low.step, [*inside, window.u[0]])
        flat = np.concatenate([*(part.ravel() for part in inside), window.u[0]])

        def moved(values: Array) -> Array:
            parts, place = list[Array](), 0
            for part in inside:
                parts.append(values[place : place + part.size].reshape(1, *part.shape))
                place += part.size
            whole = iter(parts)
            tree = jax.tree.map(lambda a: next(whole) if np.size(a) else a, state)
            after, y = model.step(tree, values[None, place:])
            left = [np.ravel(part) for part in jax.tree.leaves(after) if np.size(part)]
            return np.concatenate([np.ravel(y), *left])

        for i in range(len(flat)):
            move = 1e-6 * np.eye(len(flat))[i]
            slope = (moved(flat + move) - moved(flat - move)) / 2e-6
            assert slopes[:, i] == pytest.approx(slope, abs=1e-7)


def test_without_a_past_window_the_state_lies_one_sample_before() -> None:
    context = replace(CONTEXT, n_past_u=0, n_past_y=0)
    model, new = fitted("first", context), record(1)
    past = np.zeros((1, 0, 1))
    y = model.simulate(past, past, new.u[None])
    assert simulate_steps(model, past, past, new.u[None]) == pytest.approx(y, abs=1e-10)


def test_a_staircase_is_held_whatever_is_asked_for_the_others() -> None:
    random = np.random.default_rng(0)
    u = np.stack([np.repeat(random.normal(size=60), 4), random.normal(size=240)], axis=1)
    records = [Trajectory(u, u, 1.0, "r")]
    signals = Signal("a"), Signal("b")
    assert staircases(records) == (True, False)
    assert between(signals, records, "first").kinds == ("zero", "first")
    assert between(signals, records, None).kinds == ("zero", "zero")
    assert undecided_inputs(signals, records) == signals[1:]
    stated = Signal("a", intersample="first"), Signal("b", intersample="zero")
    assert between(stated, records, "band_limited").kinds == ("first", "zero")
    assert undecided_inputs(stated, records) == ()
    source = Recipe("greybox", (("intersample", "first"),), "LevenbergMarquardt", ()).source("")
    assert inputs_of(source, signals, records) == ("zero", "first")
    assert inputs_of("def fit(t, c): pass", signals, records) == ("zero", "zero")


def test_a_curve_needs_one_sampling_time() -> None:
    signals = Signal("u"), Signal("step", "s", "time_step")
    u = np.random.default_rng(0).normal(size=(50, 2))
    records = [Trajectory(u, u[:, :1], 1.0, "r")]
    assert between(signals, records, "first").kinds == ("first", "zero")
    with pytest.raises(UserError, match="needs one sampling time"):
        between(signals, records, "band_limited")


def test_the_records_show_an_input_that_moves_between_samples() -> None:
    moving = record(0, 2_000)
    random = np.random.default_rng(1)
    noisy = replace(moving, y=moving.y + 0.01 * random.normal(size=moving.y.shape))
    # The same input, held: the output of a sample does not know its input yet.
    system = ([[0.0, 1.0], [-6.0, -0.4]], [[0.0], [5.0]], [[1.0, 0.0]], [[0.0]])
    fine = np.repeat(moving.u[:, 0], 20)
    _, y, _ = lsim(system, fine, STEP / 20 * np.arange(len(fine)), interp=False)
    held = replace(moving, y=y[::20, None] + 0.01 * random.normal(size=moving.y.shape))
    assert at_once((noisy,))[0, 0] < 1e-6
    assert at_once((held,))[0, 0] > 0.01


def test_hybrid_and_compartments_hand_the_setting_on() -> None:
    config = hybrid.Config(units=2, intersample="first")
    assert hybrid.build(config, CONTEXT).structure.config.intersample == "first"
    assert compartments.Config(intersample="first").intersample == "first"
    with pytest.raises(ValueError, match="intersample"):
        greybox.Config(intersample="second")  # pyright: ignore[reportArgumentType]


LAG = b"""
from scipy.signal import lfilter
def simulate(u, params, x0, dt):
    a = 2.718281828459045 ** (-dt / params["tau"])
    return lfilter([0, 1 - a], [1, -a], u[:, 0])
"""


def test_a_simulator_that_holds_its_inputs_is_called_with_shorter_samples() -> None:
    u = np.random.default_rng(0).normal(size=150)
    u[0] = 0.0
    system = ([[-1.0 / 0.6]], [[1.0 / 0.6]], [[1.0]], [[0.0]])
    _, y, _ = lsim(system, u, STEP * np.arange(150), interp=True)
    plant = Plant(source="plant.py:simulate", parameters={"tau": Unknown(0.1, 5.0)}, code=LAG)
    context = Context((Signal("u"),), (Signal("y"),), STEP, 2, 2, plant=plant)
    records = [Trajectory(u[:, None], y[:, None], STEP, "r")]
    wrong: dict[str, float] = {}
    for kind in KINDS[:2]:
        built = simulator.build(simulator.Config(intersample=kind), context)
        model = simulator.train(built, records, context, LevenbergMarquardt(10, starts=1))
        assert model.fitted is not None
        left = model.run(records[0].u, model.fitted.z, np.zeros(0)) - records[0].y
        wrong[kind] = float(left.std() / y.std())
    assert wrong["first"] < 0.05 * wrong["zero"]
