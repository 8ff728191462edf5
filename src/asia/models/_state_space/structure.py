"""Equations of neural state-space models, with friction and play elements."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from itertools import combinations_with_replacement
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from asia.data.trajectory import Array
from asia.models._arrays import AnyArray, bounded, namespace, relu, scan
from asia.models._linear.fit import free_entries, held_entries
from asia.models._linear.system import LinearSystem
from asia.models._linear.window_predictor import WindowLags, WindowPredictor

# Elements of dry friction and of play in a discrete state-space model, for NumPy and JAX.
#
# An element of friction resists the motion of a learned direction of the state and is solved
# implicitly, so that the state can stand still. With the next state x' that there would be without
# it, q = w' x' + b and gain g, its force is F = sat((z + k q) / (1 + k w' g)), its next state is
# F, and x' - g F follows. A stiff one (k large) is Coulomb friction, a soft one an elastoplastic
# spring; several together make hysteresis of any shape. An element of play follows a direction of
# state and input within a width; what is not followed acts on state and output. Sources: Iwan, J.
# Applied Mechanics 33(4), 1966; Visintin, Differential Models of Hysteresis, Springer 1994.

Coefficients = Mapping[str, Any]

# Limit on the exponents of learned ratios, which keeps them finite.
_LARGEST = 8.0


def resisted(
    p: Coefficients, now: AnyArray, z: AnyArray, free: AnyArray
) -> tuple[AnyArray, AnyArray]:
    """Solve the friction of one sample, with states `now` (..., n), forces z (..., m) and the next
    state `free` (..., n) without friction; return the next state with friction, and the forces in
    it."""
    xp = namespace(free)
    stiffness = xp.exp(bounded(p["stiff"], -_LARGEST, _LARGEST))
    uneven = xp.exp(bounded(p["uneven"], -_LARGEST, _LARGEST))
    speed = (now @ p["w"] + p["b"]) * xp.exp(bounded(p["narrow"], -_LARGEST, _LARGEST))
    level = 1.0 + p["extra"] * xp.exp(-(speed**2))
    level = xp.maximum(level, 0.05)
    yielding = 1.0 + stiffness * relu((p["w"] * p["g"].T).sum(axis=0))
    force = (z + stiffness * (free @ p["w"] + p["b"])) / yielding
    force = bounded(force, -level / uneven, level * uneven)
    return free - force @ p["g"], force


def lost(p: Coefficients, x: AnyArray, v: AnyArray, behind: AnyArray) -> tuple[AnyArray, AnyArray]:
    """Solve the play of one sample, with states x (..., n), inputs v (..., nu) and followers
    `behind` (..., m) before it; return the motion that the play takes, and the followers after
    it."""
    signal = x @ p["w"] + v @ p["wu"]
    after = bounded(behind, signal - 1.0, signal + 1.0)
    return signal - after, after


# Equations of the neural state-space models, for NumPy and JAX arrays alike.
#
# x[k+1] = A x + B v + f, w = C x + D v + offset + g, v = u + s(u), y = w + r(w), where the
# functions that a structure leaves out are zero, and those it has end in a layer that starts at
# zero, so that the model starts as the linear one. Elements of friction and of play have states of
# their own after x.

Nonlinearity = Literal["state", "modal", "input", "output", "both", "none"]
# Layers: tanh, or sqrt(1 + z^2), whose sums go on as straight lines where records end.
Basis = Literal["tanh", "multiquadric", "polynomial", "scheduling"]
LAYERS = ("tanh", "multiquadric")

# Limit on the unit-size signals of monomials, so that a simulation that leaves the training range
# grows linearly at most.
_RANGE = 4.0
# Limit that the amplitude of a mode of unit size approaches in its effect on stiffness and damping.
_AMPLITUDE = 2.0


@dataclass(frozen=True)
class StateSpaceStructure:
    """Sizes and kind of the functions; hashable."""

    order: int  # Number of states
    nu: int  # Number of inputs
    ny: int  # Number of outputs
    nonlinearity: Nonlinearity  # Place of the static functions
    basis: Basis  # Basis of the functions
    hidden: int  # Units of a layer
    degree: int  # Greatest degree of polynomials
    channels: int | None
    """Number of linear combinations of [x, v] that f and g read; None lets them read all of [x,
    v]."""
    lags: WindowLags | None = None
    """Lags of a state that is the past window itself: its next value follows from the output,
    and f is left out."""
    friction: int = 0  # Number of elements of dry friction, each with a state
    play: int = 0  # Number of elements of play, each with a state
    integrators: int = 0
    """Number of last states whose pole is held at 1 and which f and g do not read."""
    scheduling: tuple[int, ...] = ()
    """Scheduling inputs of the basis "scheduling": its monomials have at most one other signal."""
    pairs: int = 0  # Number of complex pairs, whose states come first, with "modal"

    @property
    def size(self) -> int:
        """Number of states of the model and of its elements."""
        return self.order + self.friction + self.play

    @property
    def starts_vary(self) -> bool:
        """Starting points differ: polynomials all start at zero."""
        drawn = self.nonlinearity not in ("none", "modal") and self.basis in LAYERS
        return drawn or self.channels is not None or self.size > self.order

    def input(self, p: Coefficients, u: Any) -> Any:
        """Input v after the static function s, from u (..., nu)."""
        return u + self._net(p["s"], u) if "s" in p else u

    def split(self, p: Coefficients, x: Any, v: Any) -> tuple[Any, Any]:
        """Advance states x (..., n) with inputs v (..., nu); return the outputs before r too."""
        if "dry" not in p and "play" not in p:
            return self._smooth(p, x, v)
        n, m = self.order, self.order + self.friction
        now, force, behind = x[..., :n], x[..., n:m], x[..., m:]
        state, output = self._smooth(p, now, v)
        parts: list[Any] = []
        if "play" in p:
            missed, behind = lost(p["play"], now, v, behind)
            state, output = state + missed @ p["play"]["g"], output + missed @ p["play"]["h"]
        if "dry" in p:
            output = output + force @ p["dry"]["h"]
            state, force = resisted(p["dry"], now, force, state)
            parts.append(force)
        if "play" in p:
            parts.append(behind)
        return namespace(x, v).concatenate([state, *parts], axis=-1), output

    def _smooth(self, p: Coefficients, x: Any, v: Any) -> tuple[Any, Any]:
        """Advance as `split` does, without elements."""
        output = x @ p["c"] + v @ p["d"] + p["offset"]
        if self.lags is not None:
            output = output + self._change(p, x, v)
            keep, from_u, from_y = _shift(self.lags)
            return x @ keep + v @ from_u + output @ from_y, output
        a = p["a"]
        if self.integrators:
            free, held = _transposed_entries(self.order, self.integrators)
            a = a * free.astype(a.dtype) + held.astype(a.dtype)
        state = x @ a + v @ p["b"]
        if "f" not in p:
            return state, output
        change = self._change(p, x, v)
        return state + change[..., : self.order], output + change[..., self.order :]

    def _change(self, p: Coefficients, x: Any, v: Any) -> Any:
        x = x[..., : self.order - self.integrators] if self.integrators else x
        both = namespace(x, v).concatenate([x, v], axis=-1)
        if self.nonlinearity == "modal":
            return self._by_amplitude(x) @ p["f"]["w2"]
        if self.channels is None:
            return self._net(p["f"], both)
        return self._net(p["f"], both @ p["read"]) @ p["act"]

    def _by_amplitude(self, x: Any) -> Any:
        """Each mode times the powers of its amplitude from 1 to degree - 1: stiffness and damping
        that depend on the amplitude, and hardly change beyond the training range."""
        terms: list[Any] = []
        for mode in self._modes:
            square = (x[..., mode] ** 2).sum(axis=-1, keepdims=True) + 1e-12
            size = namespace(x).sqrt(square / (1.0 + square / _AMPLITUDE**2))
            terms += [size**power * x[..., mode] for power in range(1, self.degree)]
        return namespace(x).concatenate(terms, axis=-1)

    @property
    def _modes(self) -> list[slice]:
        """The states of each complex pair."""
        return [slice(i, i + 2) for i in range(0, 2 * self.pairs, 2)]

    def output(self, p: Coefficients, w: Any) -> Any:
        """Output y after the static function r, from w (..., ny)."""
        return w + self._net(p["r"], w) if "r" in p else w

    def units(self, p: Coefficients, z: Any) -> Any:
        """Units of a layer at signals z."""
        inner = z @ p["w1"] + p["b1"]
        if self.basis == "tanh":
            return namespace(z).tanh(inner)
        return namespace(z).sqrt(1.0 + inner * inner)

    def _net(self, p: Coefficients, z: Any) -> Any:
        if self.basis in LAYERS:
            return self.units(p, z) @ p["w2"]
        z = bounded(z, -_RANGE, _RANGE)
        terms = [z[..., i].prod(axis=-1) for i in self._monomials(z.shape[-1])]
        return namespace(z).concatenate(terms, -1) @ p["w2"]

    def _monomials(self, signals: int) -> tuple[NDArray[np.intp], ...]:
        if self.basis == "polynomial":
            return _monomials(signals, self.degree)
        return _monomials(
            signals, self.degree, tuple(signals - self.nu + j for j in self.scheduling)
        )

    def start_windowed(
        self, predictor: WindowPredictor, rng: np.random.Generator
    ) -> dict[str, Any]:
        """Parameters that simulate as the linear model whose state is the past window."""
        n, theta = self.order, predictor.theta
        p: dict[str, Any] = {"c": theta[:n], "d": theta[n:-1], "offset": theta[-1]}
        self._add_state_function(p, rng, self.ny)
        return p

    def start(self, system: LinearSystem, rng: np.random.Generator) -> dict[str, Any]:
        """Parameters that simulate as the linear system."""
        names = ("a", "b", "c", "d", "offset")
        p: dict[str, Any] = {k: v.T for k, v in zip(names, system.matrices, strict=True)}
        n, nu, ny = self.order, self.nu, self.ny
        if self.nonlinearity == "state":
            self._add_state_function(p, rng, n + ny)
        if self.nonlinearity == "modal":
            p["f"] = {"w2": np.zeros(((self.degree - 1) * 2 * self.pairs, n + ny))}
        if self.nonlinearity in ("input", "both"):
            p["s"] = self._function(rng, nu, nu)
        if self.nonlinearity in ("output", "both"):
            p["r"] = self._function(rng, ny, ny)
        return p

    def _add_state_function(
        self, p: dict[str, Any], rng: np.random.Generator, outputs: int
    ) -> None:
        inputs, m = self.order - self.integrators + self.nu, self.channels
        if m is None:
            p["f"] = self._function(rng, inputs, outputs)
        else:
            p["f"] = self._function(rng, m, m)
            p["read"] = rng.standard_normal((inputs, m)) / np.sqrt(inputs)
            p["act"] = rng.standard_normal((m, outputs)) / np.sqrt(outputs)

    def _function(self, rng: np.random.Generator, inputs: int, outputs: int) -> dict[str, Any]:
        if self.basis not in LAYERS:
            size = sum(len(i) for i in self._monomials(inputs))
            return {"w2": np.zeros((size, outputs))}
        return {
            "w1": rng.standard_normal((inputs, self.hidden)) / np.sqrt(inputs),
            "b1": rng.uniform(-1.5, 1.5, self.hidden),
            "w2": np.zeros((self.hidden, outputs)),
        }

    def simulate(self, p: Coefficients, x0: AnyArray, u: AnyArray) -> tuple[AnyArray, AnyArray]:
        """Simulate from x0 (B, n) with u (B, T, nu): states (B, T, n) and outputs (B, T, ny),
        NumPy or JAX."""

        def step(x: AnyArray, v: AnyArray) -> tuple[AnyArray, tuple[AnyArray, AnyArray]]:
            after, output = self.split(p, x, v)
            return after, (x, output)

        _, (states, outputs) = scan(step, x0, self.input(p, u).swapaxes(0, 1))
        return states.swapaxes(0, 1), self.output(p, outputs.swapaxes(0, 1))


# Called at every sample of a simulation.
@cache
def _monomials(
    signals: int, degree: int, scheduling: tuple[int, ...] | None = None
) -> tuple[NDArray[np.intp], ...]:
    """Indices (monomials, degree) of the signals that are multiplied, for each degree from 2 on.

    Args:
        scheduling: signals of which all but one factor must be; None for any factors
    """
    found: list[NDArray[np.intp]] = []
    for d in range(2, degree + 1):
        every = combinations_with_replacement(range(signals), d)
        kept = [i for i in every if scheduling is None or sum(k in scheduling for k in i) >= d - 1]
        found.append(np.array(kept))
    return tuple(found)


@cache
def _transposed_entries(order: int, integrators: int) -> tuple[Array, Array]:
    return free_entries(order, integrators).T, held_entries(order, integrators).T


@cache
def _shift(lags: WindowLags) -> tuple[Array, Array, Array]:
    return lags.shift()
