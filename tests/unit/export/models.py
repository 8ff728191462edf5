"""Models of the library with numbers of no fit: what they simulate is as good for a comparison."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import numpy as np

from asia.candidate import Context
from asia.data import Signal, Trajectory
from asia.data.relations import Transport
from asia.data.segment import SimulatedSegment
from asia.data.trajectory import Intersample
from asia.export.model import ExportModel
from asia.export.pipeline import Ready
from asia.lowering.program import LoweredModel
from asia.lowering.trace import lowered_bytes
from asia.lowering.wire import unpack
from asia.models import (
    autoregressive,
    cascaded_ltc,
    cnn,
    greybox,
    koopman,
    linear,
    ltc,
    neural_ss,
    recurrent,
    subnet,
    transformer,
)
from asia.models._equations.fit import FittedEquations
from asia.models._equations.simulate import Scales, WindowPrior
from asia.models._linear.system import LinearSystem
from asia.models._numerics.encoder import affine
from asia.models._numerics.intersample import Between
from asia.models._numerics.lags import History, Lags, OutputRange
from asia.models._numerics.scaling import Scaling
from asia.models._one_step import FreeRunModel, Polynomial, PolynomialRun, all_terms
from asia.models._state_space.model import FittedStateSpace
from asia.models._state_space.structure import StateSpaceStructure
from asia.problem.physics import ParameterRange, Physics
from tests.unit.models.systems.memory import remembering

NU, NY, PAST = 2, 2, 3
CONTEXT = Context(
    tuple(Signal(f"u{i}", "V") for i in range(NU)),
    tuple(Signal(f"y{i}", "mm") for i in range(NY)),
    0.5,
    PAST,
    PAST,
)
SCALING = Scaling(np.array([1.0, -2.0]), np.array([0.5, 2.0]), np.array([5.0, 0.1]), np.ones(NY))
rng = np.random.default_rng(3)


def drawn(*shape: int) -> Any:
    return 0.4 * rng.standard_normal(shape)


def encoder(states: int) -> Any:
    return affine(drawn(PAST * (NU + NY), states), drawn(states))


def system() -> LinearSystem:
    a = np.array([[0.8, 0.2, 0.0], [-0.1, 0.7, 0.1], [0.0, 0.0, 0.5]])
    return LinearSystem(a, drawn(3, NU), drawn(NY, 3), drawn(NY, NU), drawn(NY))


def linear_model(delay: int) -> Any:
    fitted = linear.FittedLinear(system(), encoder(3), delay, SCALING)
    return linear.LinearStateSpace(linear.Config(), fitted)


def levels_model() -> Any:
    each = tuple(linear.FittedLinear(system(), encoder(3), 0, SCALING) for _ in range(3))
    found = linear.FittedLevels(each, np.array([0.3, 0.8, 1.5]), 7)
    return linear.LinearStateSpace(linear.Config(), None, found)


def state_space_model(basis: Any, place: Any = "state") -> Any:
    play = 1 if basis == "tanh" else 0
    structure = StateSpaceStructure(
        3, NU, NY, place, basis, 4, 2, None, friction=1, play=play, pairs=1
    )
    p = structure.start(system(), rng)
    p["f"] = {k: v + 0.1 * rng.standard_normal(v.shape) for k, v in p["f"].items()}
    p["dry"] = {
        "w": drawn(3, 1), "b": drawn(1), "stiff": drawn(1), "uneven": drawn(1),
        "narrow": drawn(1), "extra": drawn(1), "g": drawn(1, 3), "h": drawn(1, NY),
    }  # fmt: skip
    if structure.play:
        p["play"] = {"w": drawn(3, 1), "wu": drawn(NU, 1), "g": drawn(1, 3), "h": drawn(1, NY)}
    fitted = FittedStateSpace(structure, p, encoder(structure.size), 1, SCALING)
    return neural_ss.NeuralStateSpace(neural_ss.Config(), fitted)


def carried_model() -> Any:
    """Behind a pipe in which inputs stay for up to eight samples."""
    wide = replace(SCALING, u_mean=np.r_[SCALING.u_mean, 1.0], u_std=np.r_[SCALING.u_std, 0.5])
    structure = StateSpaceStructure(3, NU + 1, NY, "state", "tanh", 4, 2, None)
    p = structure.start(replace(system(), b=drawn(3, NU + 1), d=drawn(NY, NU + 1)), rng)
    p["f"] = {k: v + 0.1 * rng.standard_normal(v.shape) for k, v in p["f"].items()}
    start = affine(drawn(PAST * (NU + 1 + NY), 3), drawn(3))
    fitted = FittedStateSpace(structure, p, start, 1, wide, transport=Transport(0, 4.0, 0.55))
    return neural_ss.NeuralStateSpace(neural_ss.Config(), fitted)


def network(family: Any, **settings: Any) -> Any:
    model = family.build(family.Config(**settings), CONTEXT)
    seen = Trajectory(drawn(30, NU), drawn(30, NY), 0.5, "seen")
    model = replace(model, cell=replace(model.cell, drive=model.cell.drive.fitted([seen])))

    def moved(a: Any) -> Any:
        return (np.asarray(a) + 0.1 * rng.standard_normal(np.shape(a))).astype(np.float32)

    return replace(model, params=jax.tree.map(moved, model.params), scaling=SCALING)


def polynomial_model() -> Any:
    lags = Lags(2, 5, 1)
    terms = all_terms(lags.outputs * NY + lags.inputs * NU, 2)
    theta = 0.05 * rng.standard_normal((len(terms), NY))
    history = History(lags, 0, lags.past_inputs - PAST, None)
    limits = OutputRange(-3 * np.ones(NY), 3 * np.ones(NY))
    one = Polynomial(terms, theta, np.ones(theta.shape, bool))
    return FreeRunModel(None, PolynomialRun(one, history, limits), SCALING)


MODELS: dict[str, Callable[[], Any]] = {
    "linear": lambda: linear_model(0),
    "linear with delay": lambda: linear_model(5),
    "linear with levels": levels_model,
    "neural_ss": lambda: state_space_model("tanh"),
    "neural_ss, polynomial": lambda: state_space_model("polynomial"),
    "neural_ss, modes": lambda: state_space_model("polynomial", "modal"),
    "neural_ss with transport": carried_model,
    "equations with memory": remembering,
    "narx": polynomial_model,
    "gru": lambda: network(recurrent, cell="gru", hidden=5, layers=2),
    "lstm": lambda: network(recurrent, hidden=5, features=("square", "sqrt")),
    "rnn": lambda: network(recurrent, cell="rnn", hidden=5),
    "subnet": lambda: network(subnet, width=5),
    "autoregressive": lambda: network(autoregressive, hidden=5),
    "ltc": lambda: network(ltc, hidden=5),
    "cascaded_ltc": lambda: network(cascaded_ltc, slow=3, fast=3, width=4),
    "cnn": lambda: network(cnn, receptive_field=8, width=3, memory=3),
    "koopman": lambda: network(koopman, states=2, width=3, lift=2),
    "grey-box, linear inputs": lambda: grey_box("first", "zero"),
    "grey-box, band-limited inputs": lambda: grey_box("band_limited", "first"),
    "transformer": lambda: network(transformer, width=6, heads=2, inner=4, span=5),
}


def grey_box(*between: Intersample) -> greybox.GreyBox:
    """Two lags whose inputs behave so between samples."""
    physics = Physics(
        states=("a", "b"),
        dynamics={"a": "k*(u0 - 1) - a", "b": "a*(1 + 0.1*a) - 2*b + 0.3*(u1 + 2)"},
        parameters={"k": ParameterRange(0.5, 2.0)},
        observation={"y0": "5 + b", "y1": "0.1 + a - b"},
    )
    built = greybox.build(greybox.Config(), replace(CONTEXT, physics=physics))
    ones = [np.ones(n) for n in (2, 2, 2, 2, 2, 2, 2)]
    scales = Scales(*ones, np.full(2, -50.0), np.full(2, 50.0), np.zeros((0, 5)))
    mean = 0.1 * np.random.default_rng(4).normal(size=(2, 1 + PAST * (NU + NY)))
    prior = WindowPrior(mean, np.full(2, 0.3), SCALING.y_mean, np.full(2, 0.1))
    fitted = FittedEquations(np.array([0.2]), scales, prior, np.zeros(1))
    return greybox.GreyBox(
        replace(built.structure, intersample=Between(between or ("zero",) * NU)), fitted
    )


def lowered_model(model: Any) -> LoweredModel:
    found = unpack(lowered_bytes(model, PAST, PAST, NU, NY))
    assert isinstance(found, LoweredModel), found
    return found


def ready(model: Any, lowered: LoweredModel | None = None, samples: int = 40) -> Ready:
    """The model with two windows that it simulated itself."""
    low = lowered_model(model) if lowered is None else lowered
    random = np.random.default_rng(0)
    windows = []
    for length in (samples, samples // 2):
        past_u = SCALING.u_mean + SCALING.u_std * random.uniform(-1, 1, (PAST, NU))
        past_y = SCALING.y_mean + random.uniform(-1, 1, (PAST, NY))
        u = SCALING.u_mean + SCALING.u_std * random.uniform(-1, 1, (length, NU))
        y_hat = model.simulate(past_u[None], past_y[None], u[None])[0]
        windows.append(SimulatedSegment(past_u, past_y, u, y_hat, y_hat=y_hat))
    spans = np.array([[0.5, 1.5], [-4.0, 0.0]])
    export = ExportModel(
        "run1", "refit", "made_up", low, CONTEXT.inputs, CONTEXT.outputs, 0.5, spans, spans,
        windows[0].part(0, 10),
    )  # fmt: skip
    return Ready(export, tuple(windows))
