"""Neural state-space model with an encoder (SUBNET).

x[k+1] = A x + B u + f(x, u),  y = C x + D u + offset + h(x, u), where f and h are small networks
and the state at the first sample is a linear map plus a network of the past window: trained on
truncated simulations, each from its own past window (`methods.Adam(truncation=...)`). The linear
part and the linear encoder may start from the best linear model of that order. Some of the states
may be free integrators. Sources: Beintema, Schoukens and Toth, Deep subspace encoders for nonlinear
system identification, Automatica 156, 2023; Schoukens, Improved initialization of state-space
artificial neural networks, ECC 2021.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal

import numpy as np

from asia.candidate import Context
from asia.data.trajectory import Array, Trajectory
from asia.models import linear
from asia.models._arrays import AnyArray, bounded, namespace
from asia.models._config import check_at_least, check_choice, demand
from asia.models._linear.fit import Refinement, drift_shift, encoder_of, free_entries, held_entries
from asia.models._linear.system import LinearSystem
from asia.models._linear.window_predictor import WindowLags, one_step
from asia.models._networks.network import Driven, NetworkModel, Prepare, as_built, network_family
from asia.models._networks.structure import (
    Params,
    check_features,
    dense,
    drive_size,
    log_spaced,
    mlp,
    mlp_params,
    zeros,
)
from asia.models._numerics.scaling import Scaling
from asia.models._numerics.training_records import ScaledData, cut_windows, window_size

__all__ = ["Config", "NetworkModel", "build", "train"]


# Limit far outside the training range, which keeps an unstable model from overflowing.
_LARGEST_STATE = 30.0
_MOST_WINDOWS = 1000
_ONE_STEP_RIDGE = 1e-4


@dataclass(frozen=True)
class Config:
    """Size of the state and of its networks, and the model that training starts from."""

    states: int = 4
    """States of the model."""
    width: int = 32
    """Units of an inner layer of f, of h and of the encoder's network."""
    layers: int = 1
    """Inner layers of each of these."""
    start: Literal["linear", "random"] = "linear"
    """"linear" starts at the best linear model with as many states or, where the problem has a
    horizon, at one whose state holds the last outputs, if there are enough states for one sample
    of them; "random" starts from time constants between 1 and 100 samples."""
    features: tuple[str, ...] = ()
    """Functions of the inputs offered beside them, see `asia.models._networks.structure`."""
    integrators: int = 0
    """Free integrators: the last of the states, whose pole is held at 1 and which f and h do not
    read."""

    def __post_init__(self) -> None:
        check_at_least(1, self, "states", "width", "layers")
        check_at_least(0, self, "integrators")
        demand(self, "integrators", self.integrators < self.states, "less than the states")
        check_choice(self, "start", ("linear", "random"))
        check_features(self)


@dataclass(frozen=True)
class SubnetCell(Driven[Config]):
    """Structure of the model: see `asia.models._networks.structure.Cell`."""

    def parameters(self, context: Context) -> Params:
        """Untrained parameters drawn from `context.seed`, without the linear model."""
        rng, c = np.random.default_rng(context.seed), self.config
        d, n, nu, ny = window_size(context), c.states, context.nu, context.ny
        inner = (c.width,) * c.layers
        driven = n - c.integrators + drive_size(c.features, nu)
        decay = np.exp(-np.exp(-log_spaced(1.0, 100.0, n)))
        return {
            "a": np.diag(decay).astype(np.float32),
            "b": (np.sqrt(1 - decay**2) * dense(rng, nu, n)).astype(np.float32),
            "c": dense(rng, n, ny),
            "d": zeros(nu, ny),
            "offset": zeros(ny),
            "encode_w": dense(rng, d, n),
            "encode_b": zeros(n),
            "encode": mlp_params(rng, (d, *inner, n), last_gain=0.0),
            "f": mlp_params(rng, (driven, *inner, n), last_gain=0.0),
            "h": mlp_params(rng, (driven, *inner, ny), last_gain=0.0),
        }

    def start(self, trajectories: Sequence[Trajectory], context: Context) -> Prepare | None:
        """Start from the linear model, or as drawn."""
        del trajectories
        if self.config.start == "random":
            return as_built
        return partial(_from_linear_model, context=context, integrators=self.config.integrators)

    def initial(self, params: Any, window: AnyArray) -> AnyArray:
        """State at the first sample."""
        linear_part = window @ params["encode_w"] + params["encode_b"]
        return linear_part + mlp(params["encode"], window)

    def step(self, params: Any, state: AnyArray, u: AnyArray) -> tuple[AnyArray, AnyArray]:
        """Advance by one sample; the features are the state before it."""
        a, c = params["a"], self.config
        if c.integrators:
            free, held = (find(c.states, c.integrators).T for find in (free_entries, held_entries))
            a = a * free.astype(a.dtype) + held.astype(a.dtype)
        after = state @ a + u @ params["b"] + self._bent(params["f"], state, u)
        return bounded(after, -_LARGEST_STATE, _LARGEST_STATE), state

    def output(self, params: Any, features: AnyArray, u: AnyArray) -> AnyArray:
        """Output C x + D u + offset + h(x, u)."""
        bent = self._bent(params["h"], features, u)
        return features @ params["c"] + u @ params["d"] + params["offset"] + bent

    def _bent(self, layers: Any, state: AnyArray, u: AnyArray) -> AnyArray:
        """f or h, of the states that come back."""
        read = state[..., : self.config.states - self.config.integrators]
        return mlp(layers, namespace(read, u).concatenate([read, self.drive(u)], axis=-1))


def _from_linear_model(
    params: Params, records: ScaledData, scaling: Scaling, *, context: Context, integrators: int
) -> Params:
    del scaling
    states = len(params["a"])
    if integrators:
        # Inputs at which the integrators are at rest are not the zero of the z-scores: the effect
        # of these inputs goes into the constants of f and of the output.
        choice = linear.Config(order=states, integrators=integrators)
        shift = drift_shift(records, states, integrators)
        moved = [replace(r, u=r.u + shift, undelayed_u=r.undelayed_u) for r in records]
        found, _, used = linear.fit_records(moved, context, choice, Refinement())
        encoder, s = encoder_of(used, found, context), found.system
        at_rest = LinearSystem(s.a, s.b, s.c, s.d, s.offset + s.d @ shift)
        params = _embedded(params, at_rest, encoder.weights, encoder.bias)
        return _with_constant(params, s.b @ shift)
    lags = WindowLags(
        context.n_past_u, context.n_past_y, 0, context.n_past_y, context.nu, context.ny
    )
    if context.horizon is None or lags.y == 0:
        found, _, used = linear.fit_records(
            records, context, linear.Config(order=states), Refinement()
        )
        encoder, s = encoder_of(used, found, context), found.system
        return _embedded(params, s, encoder.weights, encoder.bias)
    if states < context.ny:
        return params
    # A state that holds the last outputs follows from the past window, and is cheap to fit.
    lags = replace(lags, y=min(lags.y, states // context.ny))
    windows = cut_windows(records, context, _MOST_WINDOWS)
    s, encoder = one_step(windows, lags, _ONE_STEP_RIDGE).system()
    n = lags.order
    # The last state, the constant 1, moves from A and C to the constant of f and the offset.
    system = LinearSystem(s.a[:n, :n], s.b[:n], s.c[:, :n], s.d, s.offset + s.c[:, n])
    params = _embedded(params, system, encoder.weights[:, :n], encoder.bias[:n])
    return _with_constant(params, np.pad(s.a[:n, n], (0, states - n)))


def _with_constant(params: Params, constant: Array) -> Params:
    """Set the constant of f."""
    last = {**params["f"][-1], "b": constant.astype(np.float32)}
    return {**params, "f": [*params["f"][:-1], last]}


def _embedded(params: Params, s: LinearSystem, weights: Array, bias: Array) -> dict[str, Any]:
    """Put the system into the first states of the parameters; the output does not read the
    others."""
    n = s.order
    result = {**params, "d": np.asarray(s.d.T, np.float32), "offset": s.offset.astype(np.float32)}
    result["c"] = np.zeros_like(params["c"])
    for name, value, place in (
        ("a", s.a.T, np.s_[:n, :n]),
        ("b", s.b.T, np.s_[:, :n]),
        ("c", s.c.T, np.s_[:n]),
        ("encode_w", weights, np.s_[:, :n]),
        ("encode_b", bias, np.s_[:n]),
    ):
        result[name] = result[name].copy()
        result[name][place] = value
    return result


build, train = network_family(Config, SubnetCell)
