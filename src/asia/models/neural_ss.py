"""Neural state-space model that starts as the best linear one.

x[k+1] = A x + B u + f(x, u),  y = C x + D u + g(x, u), or the same with a static function before
the linear system (Hammerstein), after it (Wiener) or both, or with f and g acting through a few
channels only (a static function in feedback with a linear system). The functions are small
networks or polynomials whose last layer starts at zero. Sources: Schoukens, Improved
initialization of state-space artificial neural networks, ECC 2021; Paduart et al., Automatica
46(4), 2010 (polynomials).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from asia.candidate import Context
from asia.errors import UserError
from asia.models import linear
from asia.models._encoder import Encoder, fit_encoder
from asia.models._linear_fit import LinearFit, Refinement, encoder_of
from asia.models._network import train_cell, window_size
from asia.models._records import Record, check, past_length, scaled, window, windows
from asia.models._scaling import Scaling
from asia.models._state_fit import fit_states
from asia.models._structure import Basis, Nonlinearity, Structure
from asia.models.methods import Adam, LevenbergMarquardt
from asia.problem import Array, Trajectory

_LINEAR = ("a", "b", "c", "d", "offset")
_NONLINEAR = ("f", "s", "r", "read", "act")


@dataclass(frozen=True)
class Config:
    """order: states, None takes the order of the best linear model but at least 2; nonlinearity:
    where the static functions are; channels: None, or through how many signals f and g act;
    basis, hidden (units of the tanh layer), degree (of the polynomial); ridge: weight, against
    the mean squared error in z-scores, of the squared distance of the nonlinear weights from
    their start; linear_ridge: the same for A, B, C, D; encoder: tanh units of the map from the
    past window to the initial state; members: with Levenberg-Marquardt, how many of the fits from
    its starts are kept, the median of their outputs taken; delay: as in `linear.Config`."""

    order: int | None = None
    nonlinearity: Nonlinearity = "state"
    channels: int | None = None
    basis: Basis = "tanh"
    hidden: int = 8
    degree: int = 3
    ridge: float = 1e-5
    linear_ridge: float = 1e-7
    encoder: int = 30
    members: int = 1
    delay: int | None = 0

    def __post_init__(self) -> None:
        if min(self.hidden, self.members) < 1 or self.degree < 2 or (self.order or 1) < 1:
            raise UserError("neural_ss.Config: order, hidden and members must be >= 1, degree >= 2")
        if self.channels is not None and (self.channels < 1 or self.nonlinearity != "state"):
            raise UserError(
                "neural_ss.Config: channels must be >= 1 and go with nonlinearity state"
            )


@dataclass(frozen=True)
class Fitted:
    """What training found; members hold parameters as `Structure` reads them, in z-scores, and
    the map from the past window to the initial state."""

    structure: Structure
    members: tuple[tuple[dict[str, Any], Encoder], ...]
    delay: int
    scaling: Scaling


@dataclass(frozen=True)
class StateCell:
    """The model as Adam trains it: see `asia.models._network.Cell`."""

    structure: Structure

    def initial(self, params: Any, window: jax.Array) -> jax.Array:
        """Encoder."""
        p = params["encoder"]
        bent = jnp.tanh(window @ p["inner"] + p["shift"])
        return window @ p["weights"] + bent @ p["outer"] + p["bias"]

    def step(self, params: Any, state: jax.Array, u: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Next state and output before r."""
        return self.structure.split(jnp, params, state, self.structure.input(jnp, params, u))

    def output(self, params: Any, features: jax.Array, u: jax.Array) -> jax.Array:
        """r."""
        del u
        return self.structure.output(jnp, params, features)


@dataclass(frozen=True)
class NeuralStateSpace:
    """Neural state-space model; `fitted` is None before training."""

    config: Config
    fitted: Fitted | None = None

    def simulate(self, past_u: Array, past_y: Array, u: Array) -> Array:
        """past_u (B, n_past_u, nu), past_y (B, n_past_y, ny), u (B, H, nu), physical units ->
        (B, H, ny). Raises UserError before training."""
        if self.fitted is None:
            raise UserError("neural state-space model: not trained yet; call train first")
        f = self.fitted
        past, future = f.scaling.inputs(past_u), f.scaling.inputs(u)
        features = window(past, f.scaling.outputs(past_y))
        inputs = linear.delayed(past, future, f.delay)
        with np.errstate(all="ignore"):
            outputs = [
                f.structure.simulate(params, encoder(features), inputs)[1]
                for params, encoder in f.members
            ]
        return f.scaling.physical(np.median(outputs, axis=0))


def build(config: Config, context: Context) -> NeuralStateSpace:
    """An untrained model."""
    del context
    return NeuralStateSpace(config)


def train(
    model: NeuralStateSpace,
    trajectories: Sequence[Trajectory],
    context: Context,
    method: LevenbergMarquardt | Adam,
) -> NeuralStateSpace:
    """Fits the linear model, then all parameters to the simulation error of all records.

    Levenberg-Marquardt suits short records and few parameters (its Jacobian takes samples x
    outputs x parameters numbers); `method.starts` initialisations are tried and the
    `config.members` with the lowest training cost are kept. Raises UserError for records too
    short or mis-shaped.
    """
    check(trajectories, context)
    scaling = Scaling.of(trajectories)
    records = scaled(trajectories, scaling)
    found, delay = _linear_start(records, context, model.config)
    late = [linear.shifted(r, delay) for r in records]
    c = model.config
    structure = Structure(
        found.system.order, context.nu, context.ny, c.nonlinearity, c.basis, c.hidden, c.degree,
        c.channels,
    )  # fmt: skip
    if isinstance(method, Adam):
        members = [_by_adam(structure, c, found, late, context, method)]
    else:
        members = _by_lm(structure, c, found, late, context, method)
    return replace(model, fitted=Fitted(structure, tuple(members), delay, scaling))


def _linear_start(
    records: Sequence[Record], context: Context, config: Config
) -> tuple[LinearFit, int]:
    choice = linear.Config(order=config.order, delay=config.delay)
    found, delay = linear.fit_records(records, context, choice, Refinement())
    if config.order is None and found.system.order < 2:
        choice = replace(choice, order=2, delay=delay)
        found, delay = linear.fit_records(records, context, choice, Refinement())
    return found, delay


def _by_lm(
    structure: Structure,
    config: Config,
    found: LinearFit,
    records: Sequence[Record],
    context: Context,
    method: LevenbergMarquardt,
) -> list[tuple[dict[str, Any], Encoder]]:
    rng = np.random.default_rng(context.seed)
    starts = [structure.start(found.system, rng) for _ in range(method.starts)]
    ridge: dict[str, float] = dict.fromkeys(_LINEAR, config.linear_ridge)
    ridge.update(dict.fromkeys(_NONLINEAR, config.ridge))
    ridge["x0"] = found.error / sum(len(r) for r in records)
    fits = fit_states(structure, starts, found.x0, records, ridge, method)
    for i, loss in enumerate(fits[0].history):
        context.log(i, float(loss))
    skip = past_length(context)
    features = [windows(r, context) for r in records]
    members: list[tuple[dict[str, Any], Encoder]] = []
    for one in fits[: config.members]:
        states = [
            structure.simulate(one.params, x[None], r.u[None])[0][0, skip:]
            for x, r in zip(one.x0, records, strict=True)
        ]
        encoder = fit_encoder(features, states, config.encoder, context.seed)
        members.append((one.params, encoder))
    return members


def _by_adam(
    structure: Structure,
    config: Config,
    found: LinearFit,
    records: Sequence[Record],
    context: Context,
    method: Adam,
) -> tuple[dict[str, Any], Encoder]:
    rng = np.random.default_rng(context.seed)
    start = encoder_of(records, found, context)
    d, n, m = window_size(context), structure.order, config.encoder
    params = {
        **structure.start(found.system, rng),
        "encoder": {
            "weights": start.weights,
            "bias": start.bias,
            "inner": rng.standard_normal((d, m)) / np.sqrt(max(d, 1)),
            "shift": rng.uniform(-1.0, 1.0, m),
            "outer": np.zeros((m, n)),
        },
    }
    trained = train_cell(StateCell(structure), _cast(params, np.float32), records, context, method)
    trained = _cast(trained, np.float64)
    return trained, Encoder(**trained.pop("encoder"))


def _cast(tree: Any, dtype: type[np.floating[Any]]) -> dict[str, Any]:
    return jax.tree.map(lambda v: np.asarray(v, dtype), tree)
