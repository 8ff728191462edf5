"""Every model family: fit, bytes, fresh worker, bitwise the same simulation; a second fit too."""

import pkgutil

import numpy as np
import pytest

import asia.models
from asia.candidate import Context, check_source
from asia.problem import ParameterRange, Physics, Signal, Trajectory
from asia.sandbox import Limits, open_worker, probe

FAMILIES = {
    "linear": ("linear.Config(order=1)", "methods.LevenbergMarquardt(iterations=5)"),
    "recurrent": ("recurrent.Config(hidden=3, encoder=3)", "methods.Adam(steps=5)"),
    "ltc": ("ltc.Config(hidden=3)", "methods.Adam(steps=5)"),
    "neural_ss": (
        "neural_ss.Config(order=1, hidden=2)",
        "methods.LevenbergMarquardt(iterations=3)",
    ),
    "greybox": ("greybox.Config(substeps=1)", "methods.LevenbergMarquardt(iterations=3)"),
    "hybrid": ("hybrid.Config(units=1)", "methods.LevenbergMarquardt(iterations=3)"),
}
CANDIDATE = """
from asia.models import FAMILY, methods


def build_model(context):
    return FAMILY.build(CONFIG, context)


def train(model, trajectories, context):
    return FAMILY.train(model, trajectories, context, METHOD)


def fit(trajectories, context):
    return train(build_model(context), trajectories, context)
"""


@pytest.fixture(scope="module")
def record() -> Trajectory:
    """A leaking tank with a pump, slightly noisy."""
    rng = np.random.default_rng(3)
    u = np.repeat(rng.uniform(0.5, 1.5, size=20), 10)
    x = np.empty(len(u))
    x[0] = 1.0
    for k in range(len(u) - 1):
        x[k + 1] = x[k] + 0.1 * (-0.5 * np.sqrt(x[k]) + 0.5 * u[k])
    return Trajectory(u, x + 0.002 * rng.normal(size=len(x)), 0.1, "tank")


@pytest.fixture(scope="module")
def context() -> Context:
    physics = Physics(
        states=("level",),
        dynamics={"level": "-k1*sqrt(level) + k2*flow"},
        parameters={"k1": ParameterRange(0.05, 5.0), "k2": ParameterRange(0.05, 5.0)},
    )
    return Context(
        (Signal("flow"),), (Signal("level"),), 0.1, n_past_u=5, n_past_y=5, physics=physics, seed=1
    )


def test_every_family_is_listed_here():
    modules = {module.name for module in pkgutil.iter_modules(asia.models.__path__)}
    assert set(FAMILIES) == {name for name in modules if not name.startswith("_")} - {"methods"}


@pytest.mark.parametrize("family", FAMILIES)
def test_a_model_comes_back_and_is_fitted_again_bitwise_the_same(family, record, context):
    config, method = FAMILIES[family]
    source = CANDIDATE.replace("FAMILY", family).replace("CONFIG", config).replace("METHOD", method)
    check_source(source)
    level, limits = probe().level, Limits(300.0, 120.0, 4096)
    cases = record.u[None, :5], record.y[None, :5], record.u[None, 5:]
    with open_worker(level, limits) as worker:
        worker.fit(source, [record], context)
        model = worker.dump()
        y = worker.simulate(*cases)
    with open_worker(level, limits) as fresh:
        fresh.load(source, model, context)
        np.testing.assert_array_equal(fresh.simulate(*cases), y)
    with open_worker(level, limits) as again:
        again.fit(source, [record], context)
        np.testing.assert_array_equal(again.simulate(*cases), y)
    assert np.std(y) > 0
