from collections.abc import Callable

import numpy as np
import pytest

from asia.agents.library.registry import all_families
from asia.candidate import Context, library_only
from asia.data.trajectory import Array, Signal, Trajectory
from asia.errors import UserError
from asia.models import linear, static_maps
from asia.models.methods import LevenbergMarquardt
from asia.recipe import Recipe, read_recipe
from asia.testing.candidate import check_candidate
from asia.testing.family import family_problem, smallest_source
from tests.contract.test_steps import check_steps

PAST = 20
CONTEXT = Context((Signal("torque", "Nm"),), (Signal("speed", "rad/s"),), 0.1, PAST, PAST)
METHOD = LevenbergMarquardt(iterations=30)

Function = Callable[[Array], Array]


def same(x: Array) -> Array:
    return x


def record(samples: int, seed: int, f: Function = same, g: Function = same) -> Trajectory:
    """A resonant system of second order between static functions, with 1 % of noise."""
    rng = np.random.default_rng(seed)
    u = np.repeat(12.0 * rng.normal(size=samples // 15 + 1), 15)[:samples]
    v, z = f(u), np.zeros(samples)
    for k in range(2, samples):
        z[k] = 1.6 * z[k - 1] - 0.7 * z[k - 2] + 0.1 * v[k - 2]
    y = g(z)
    return Trajectory(u[:, None], (y + 0.01 * y.std() * rng.normal(size=samples))[:, None], 0.1)


def error(model: linear.LinearStateSpace | static_maps.MappedModel, test: Trajectory) -> float:
    simulated = model.simulate(test.u[None, :PAST], test.y[None, :PAST], test.u[None, PAST:])
    return float(np.sqrt(np.mean((simulated[0] - test.y[PAST:]) ** 2)) / test.y.std())


def fitted(maps: static_maps.Config, training: list[Trajectory]) -> static_maps.MappedModel:
    model = static_maps.build(maps, linear.build(linear.Config(delay=None), CONTEXT))
    return static_maps.train(linear.train, model, training, CONTEXT, METHOD)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("maps", "f", "g", "gain"),
    [
        (static_maps.Config(input_map="saturation"), lambda u: np.clip(u, -6, 9), same, 20),
        (
            static_maps.Config(input_map="monotone"),
            lambda u: 8 * np.tanh(u / 8) + 0.1 * u,
            same,
            5,
        ),
        (static_maps.Config(output_map="magnitude"), same, abs, 20),
    ],
)
def test_a_static_function_is_found(
    maps: static_maps.Config, f: Function, g: Function, gain: float
) -> None:
    """Its error is at least so many times below that of the linear model alone."""
    training, test = record(800, 0, f, g), record(400, 1, f, g)
    plain = linear.train(linear.build(linear.Config(), CONTEXT), [training], CONTEXT, METHOD)
    model = fitted(maps, [training])
    assert gain * error(model, test) < error(plain, test)
    case = test.u[None, :PAST], test.y[None, :PAST], test.u[None, PAST:80]
    check_steps(model, [case], PAST, 1, 1)


@pytest.mark.long
def test_the_sign_of_a_simulation_in_mid_motion_comes_from_its_past_outputs() -> None:
    """A slow mode remembers far more than the past window shows."""
    rng = np.random.default_rng(8)
    u = np.repeat(12.0 * rng.normal(size=80), 30)
    z = np.zeros(len(u))
    for k in range(2, len(u)):
        z[k] = 1.97 * z[k - 1] - 0.975 * z[k - 2] + 0.01 * u[k - 2]
    y = abs(z + 0.01 * z.std() * rng.normal(size=len(z)))
    record = Trajectory(u[:, None], y[:, None], 0.1)
    model = fitted(static_maps.Config(output_map="magnitude"), [record[:1600]])
    errors = [error(model, record[k : k + 300]) for k in range(1600, 2100, 50)]
    assert np.median(errors) < 0.05
    assert max(errors) < 0.3


@pytest.mark.long
def test_levels_are_reported_in_units_of_the_input() -> None:
    training = [record(500, seed, lambda u: np.clip(u, -6, 9)) for seed in (2, 3)]
    found = fitted(static_maps.Config(input_map="saturation"), training).parameters()
    assert found["u1 lower level"] == pytest.approx(-6.0, abs=0.1)
    assert found["u1 upper level"] == pytest.approx(9.0, abs=0.1)
    assert any(name.startswith("gain") for name in found)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["linear", "greybox"])
def test_a_mapped_recipe_conforms(name: str) -> None:
    """Equal after storage, in a fresh worker, and in a second fit."""
    row = next(row for row in all_families() if row.name == name)
    record, context = family_problem(row)
    recipe = read_recipe(smallest_source(row, record, context))
    assert recipe is not None
    source = recipe.mapped(input_map="saturation").source("Saturated input.")
    assert library_only(source)
    found = read_recipe(source)
    assert found is not None
    assert found == recipe.mapped(input_map="saturation")
    assert found.key != recipe.key
    check_candidate(source, [record], context)


def test_a_map_is_added_changed_and_removed() -> None:
    recipe = Recipe("linear", (("order", 2),), "LevenbergMarquardt", (("iterations", 30),))
    both = recipe.mapped(input_map="saturation").mapped(output_map="magnitude")
    assert both.get("input_map") == "saturation"
    assert both.mapped(input_map=None, output_map=None) == recipe


def test_an_unknown_map_is_refused() -> None:
    with pytest.raises(UserError, match="saturation"):
        static_maps.Config(input_map="relay")  # pyright: ignore[reportArgumentType]


def test_it_says_that_it_is_not_trained() -> None:
    model = static_maps.build(static_maps.Config(), linear.build(linear.Config(), CONTEXT))
    with pytest.raises(UserError, match="not trained"):
        model.step((), np.zeros((1, 1)))
