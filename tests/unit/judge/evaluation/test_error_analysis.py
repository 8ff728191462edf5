"""The analysis of an error finds what was planted in a simulated oscillator."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from asia.candidate import Context, simulate_steps
from asia.data import Signal, Trajectory
from asia.data.segment import Segment
from asia.judge.evaluation.error_analysis import (
    error_parts,
    halved_step,
    missing_terms,
    modes,
    steps_ahead,
    terms_beyond_linear,
)
from asia.problem.protocol import ProtocolRule

STEP = 0.1
SAMPLES = 600


@dataclass(frozen=True)
class Oscillator:
    """Unit mass on a spring with damping, and a force that a fit does not know."""

    damping: float = 0.4
    cubic: float = 0.0
    coulomb: float = 0.0
    velocity: float = 0.0

    def initial(self, past_u: Any, past_y: Any, u: Any) -> Any:
        return past_y[:, -1], np.full_like(past_y[:, -1], self.velocity)

    def step(self, state: Any, u: Any) -> Any:
        x, v = state
        y = x
        for _ in range(5):
            force = u - x - self.damping * v - self.cubic * x**3
            v = v + STEP / 5 * (force - self.coulomb * np.tanh(v / 0.02))
            x = x + STEP / 5 * v
        return (x, v), y

    def simulate(self, past_u: Any, past_y: Any, u: Any) -> Any:
        return simulate_steps(self, past_u, past_y, u)


class Blind:
    """The same without steps."""

    def __init__(self, inner: Oscillator) -> None:
        self.inner = inner

    def simulate(self, past_u: Any, past_y: Any, u: Any) -> Any:
        return self.inner.simulate(past_u, past_y, u)


def records(system: Oscillator, model: Oscillator, bend: float = 0.0) -> tuple[Any, Any]:
    """A block of the system, and its simulation by the model."""
    rng = np.random.default_rng(0)
    u = 1.5 * np.repeat(rng.normal(size=SAMPLES // 15), 15)[:, None]
    past = np.zeros((1, 1)), np.zeros((1, 1))
    y, y_hat = (
        simulate_steps(m, past[0][None], past[1][None], u[None])[0] for m in (system, model)
    )
    y = y + bend * y**3 + 0.005 * rng.normal(size=y.shape)
    return Segment(*past, u, y, "record", start=1), y_hat


def first(system: Oscillator, bend: float = 0.0, model: Any = None) -> tuple[str, str] | None:
    block, y_hat = records(system, Oscillator(), bend)
    found = missing_terms([model or Oscillator()], [[block]], [[y_hat]], ["u"], ["y"])
    return (found[0].term, found[0].where) if found else None


def test_steps_ahead_tell_an_error_of_the_dynamics_from_one_that_accumulates() -> None:
    scale = np.ones(1)
    stiff, biased = Oscillator(cubic=0.5), Oscillator()
    for system, bend in ((stiff, 0.0), (biased, 0.2)):
        block, y_hat = records(system, biased, bend)
        block = replace(block, y=block.y[:, :1])
        found = steps_ahead(biased, [block], [y_hat], scale)
        assert list(found) == [1, 5, 20]
        assert found[20] > found[1]
    assert steps_ahead(Blind(biased), [block], [y_hat], scale) == {}
    assert list(steps_ahead(biased, [replace(block, y=block.y[:7])], [y_hat[:7]], scale)) == [1, 5]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("system", "bend", "term", "where"),
    [
        (Oscillator(cubic=0.1), 0.0, {"y^3", "y * |y|"}, "in the dynamics"),
        (Oscillator(damping=0.25, coulomb=0.2), 0.0, {"sign(rate(y))"}, "in the dynamics"),
        (Oscillator(), 0.05, {"y^3", "y * |y|"}, "at the output"),
    ],
)
def test_the_term_that_was_planted_comes_first(
    system: Oscillator, bend: float, term: set[str], where: str
) -> None:
    found = first(system, bend)
    assert found is not None
    assert found[0] in term
    assert found[1] == where


def test_noise_alone_names_no_term() -> None:
    assert first(Oscillator()) is None


@pytest.mark.slow
def test_a_model_without_steps_is_analysed_as_well() -> None:
    found = first(Oscillator(coulomb=0.15), model=Blind(Oscillator()))
    assert found is not None
    assert "y" in found[0]


@pytest.mark.parametrize(
    ("system", "part"),
    [(Oscillator(velocity=2.0), "initial_state"), (Oscillator(damping=0.6), "dynamics")],
)
def test_the_error_is_split_into_its_parts(system: Oscillator, part: str) -> None:
    block, y_hat = records(system, Oscillator())
    scale = block.y.std(axis=0)
    found = error_parts(Oscillator(), [block], [y_hat], scale, STEP)
    assert found.initial_state is not None
    assert found.initial_state + found.slow + found.dynamics == pytest.approx(1.0)
    assert getattr(found, part) > 0.8
    assert found.bands.sum() == pytest.approx(1.0)
    assert found.frequencies[-1] == pytest.approx(0.5 / STEP)
    blind = error_parts(Blind(Oscillator()), [block], [y_hat], scale, STEP)
    assert blind.initial_state is None


def test_a_drift_is_the_slow_part() -> None:
    block, y_hat = records(Oscillator(), Oscillator())
    block.y[:] += np.linspace(-0.5, 0.5, SAMPLES)[:, None]
    found = error_parts(Oscillator(), [block], [y_hat], block.y.std(axis=0), STEP)
    assert found.slow > 0.8
    assert found.bands[0] > 0.8


def test_modes_are_frequency_and_damping() -> None:
    block, y_hat = records(Oscillator(), Oscillator())
    (text,) = modes(Oscillator(), block, y_hat, STEP)
    frequency, damping = text.split(" Hz, damping ")
    assert float(frequency) == pytest.approx(1.0 / (2 * np.pi), rel=0.02)
    assert float(damping) == pytest.approx(0.2, abs=0.03)


@dataclass(frozen=True)
class HeldBack:
    """Lag of an input that is held back by two samples."""

    def initial(self, past_u: Any, past_y: Any, u: Any) -> Any:
        return past_y[:, -1], past_u[:, -1], past_u[:, -2]

    def step(self, state: Any, u: Any) -> Any:
        x, one, two = state
        return (0.8 * x + 0.2 * two, u, one), x

    def simulate(self, past_u: Any, past_y: Any, u: Any) -> Any:
        return simulate_steps(self, past_u, past_y, u)


def test_a_state_that_holds_back_an_input_has_its_name() -> None:
    rng = np.random.default_rng(5)
    u = rng.normal(size=(SAMPLES + 2, 1))
    bent = HeldBack().simulate(*((v + 0.3 * v**3)[None] for v in (u[:2], np.zeros((2, 1)), u[2:])))
    noise = 0.01 * rng.normal(size=(SAMPLES, 1))
    block = Segment(u[:2], np.zeros((2, 1)), u[2:], bent[0] + noise, "r", start=2)
    y_hat = HeldBack().simulate(*(v[None] for v in (u[:2], np.zeros((2, 1)), u[2:])))[0]
    found = missing_terms([HeldBack()], [[block]], [[y_hat]], ["u"], ["y"])
    names = {term.term: term.where for term in found}
    assert names["u(k-2)^3"] == "at the input"
    assert not any("x2" in name or "x3" in name for name in names)


@pytest.mark.parametrize("nonlinear", ["input", "output", "dynamics", "nothing"])
def test_the_place_of_a_nonlinearity_is_found_from_a_linear_model(nonlinear: str) -> None:
    rng = np.random.default_rng(3)
    u = np.repeat(rng.normal(size=120), 5)
    drive = np.tanh(3.0 * u) if nonlinear == "input" else u
    x, y = 0.0, np.zeros(600)
    for k in range(600):
        y[k] = x
        x += 0.2 * (drive[k] - x - (0.6 * x**3 if nonlinear == "dynamics" else 0.0))
    if nonlinear == "output":
        y = np.exp(y)
    y += 0.01 * y.std() * rng.normal(size=600)
    records = [Trajectory(u[:, None], y[:, None], 1.0, "r")]
    context = Context((Signal("u"),), (Signal("y"),), 1.0, 5, 5)
    rule = ProtocolRule(past_inputs=5, past_outputs=5)
    found = terms_beyond_linear(records, context, rule)
    windows = ProtocolRule("windows", past_inputs=5, past_outputs=5, horizon=10)
    assert terms_beyond_linear(records, context, windows) == ()
    if nonlinear == "nothing":
        assert all(term.share < 0.05 for term in found)
        return
    term = found[0]
    assert term.share > 0.2
    assert (term.where == "at the output") == (nonlinear == "output")
    if nonlinear != "output":
        assert ("u" in term.term) == (nonlinear == "input"), term


@dataclass(frozen=True)
class Euler:
    """A lag with a time constant of 1 s, by Euler steps."""

    steps: int

    def simulate(self, past_u: Any, past_y: Any, u: Any) -> Any:
        x, found = past_y[:, -1], list[Any]()
        for k in range(u.shape[1]):
            found.append(x)
            for _ in range(self.steps):
                x = x + 0.5 / self.steps * (u[:, k] - x)
        return np.stack(found, axis=1)

    def halved(self) -> "Euler":
        return Euler(2 * self.steps)


@pytest.mark.parametrize(("steps", "matters"), [(1, True), (128, False)])
def test_a_step_that_is_too_long_is_said(steps: int, matters: bool) -> None:
    rng = np.random.default_rng(0)
    u = np.repeat(rng.normal(size=(SAMPLES // 10, 1)), 10, axis=0)
    past = u[:1], np.zeros((1, 1))
    y = Euler(256).simulate(past[0][None], past[1][None], u[None])[0]
    block = Segment(*past, u, y + 0.01 * rng.normal(size=y.shape), "r", start=1)
    model = Euler(steps)
    y_hat = model.simulate(past[0][None], past[1][None], u[None])[0]
    found = halved_step(model, [block], [y_hat], np.ones(1))
    assert found is not None
    assert found.matters is matters
    assert halved_step(Blind(Oscillator()), [block], [y_hat], np.ones(1)) is None
