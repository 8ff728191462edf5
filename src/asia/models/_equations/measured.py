"""Equations whose states are all measured, with learned terms."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np

from asia.candidate import Context, Model
from asia.data.relations import LARGEST_GAIN, LEAST_CORRELATION, Motion, motion
from asia.data.trajectory import Array, Trajectory
from asia.errors import UserError
from asia.models import recurrent
from asia.models._arrays import AnyArray, namespace
from asia.models._equations.ode import Equations, equations
from asia.models._equations.simulate import physical_parameters
from asia.models._networks.network import NetworkModel
from asia.models._networks.structure import Float32, Params, cast_tree
from asia.models._numerics.scaling import Scaling
from asia.problem.physics import Bounds, Name, ParameterRange
from asia.problem.symmetry import group

# State-space step of equations whose states are all measured, with learned terms, batch first.
#
# dx/dt = gain f(x, m) + gain rate (offset + linear' s + d + net), dm/dt = (u - m) / lag
#
# The learned terms act on the equations with free parameters; gain is 1 + `gain` in the others
# (known kinematics) and 1 in these. s are normalised states and definitions that the equations
# read; d, bounded, is a disturbance that opposes the acceleration at the start and then the mean
# acceleration; net is a network. Everything learned is without effect at zero.

NetworkKind = Literal["mlp", "rnn", "gru", "lstm"]

# Number of zero samples assumed before the first one in running means, and units of changes and
# means in deviations of the signal.
_MEAN_SAMPLES = 10.0
_CHANGE, _MEAN = 2.5, 2.0
# Unit of learned delays, in samples.
_DELAY_SAMPLES = 5.0


class MeasuredState(NamedTuple):
    """State of the model before one sample, batch first."""

    x: AnyArray  # States (B, nx)
    m: AnyArray  # Inputs behind their lag (B, nu)
    d: AnyArray  # Disturbance (B, nd)
    h: Any  # State of the network
    first: AnyArray  # No sample has been simulated yet (B, 1)
    turn: Any = ()
    """Number of the transformation under which the network sees each row (B,); () is all of them,
    averaged."""
    seen: Any = ()
    """Last value (B, n), sum and number of samples of the signals that the inputs alone make."""


@dataclass(frozen=True)
class MeasuredEquations:
    """Equations from the problem file whose states are all measured."""

    system: Equations
    """The equations, with corrections as further parameters and priors as further definitions."""
    ranges: tuple[ParameterRange, ...]  # Ranges of the parameters
    order: tuple[int, ...]  # Number of the output that shows each state
    dynamic: tuple[int, ...]  # Equations with free parameters
    corrections: tuple[str, ...] = ()
    """Places in the equations where the learned terms enter; none: on the rates."""
    priors: tuple[tuple[str, float, float], ...] = ()
    """Definition in the equations, mean and deviation of each prior."""

    @property
    def kinematic(self) -> tuple[int, ...]:
        """Equations without free parameters."""
        return tuple(i for i in range(len(self.order)) if i not in self.dynamic)

    @property
    def nd(self) -> int:
        """Number of equations with free parameters."""
        return len(self.dynamic)

    @property
    def nc(self) -> int:
        """Number of places where learned terms enter."""
        return len(self.corrections) or self.nd

    def physical(self, z: AnyArray) -> AnyArray:
        """Physical parameters (np,) from coordinates in which [-1, 1] spans their ranges."""
        return physical_parameters(self.ranges, z)

    def parameters(self, z: AnyArray) -> dict[str, float]:
        """Physical parameters by name."""
        values = np.asarray(self.physical(z), np.float64)
        names = self.system.parameters[: len(self.ranges)]
        return {name: float(value) for name, value in zip(names, values, strict=True)}

    def named(self, names: tuple[str, ...], p: AnyArray, x: AnyArray, u: AnyArray) -> AnyArray:
        """Values (B, n) of states and definitions, without corrections; p (np,), x (B, nx), u (B,
        nu)."""
        if self.corrections:
            p = namespace(p).concatenate([p, np.zeros(self.nc, p.dtype)])
        return self.system.named(names, p, x.T, u.T).T

    def in_state_order(self, kinematic: AnyArray, dynamic: AnyArray) -> AnyArray:
        """Values (..., nx) in the order of the states, from those of the kinematic and the dynamic
        equations."""
        places = [*self.kinematic, *self.dynamic]
        together = namespace(kinematic, dynamic).concatenate([kinematic, dynamic], axis=-1)
        return together[..., np.argsort(places)]

    def deviations(self, z: AnyArray) -> AnyArray:
        """Differences (n,) between the parameters of coordinates z and their priors, in standard
        deviations."""
        names = tuple(name for name, _, _ in self.priors)
        mean, deviation = (np.array(v, z.dtype) for v in list(zip(*self.priors, strict=True))[1:])
        # Only parameters and constants stand in a prior.
        nothing = namespace(z).zeros((0,), z.dtype)
        return (self.named(names, self.physical(z), nothing, nothing) - mean) / deviation


@dataclass(frozen=True)
class InputLag:
    """First-order lag of the inputs."""

    sampling_time: float  # In s
    past_inputs: bool  # Whether a past window shows inputs, from which the lag starts

    def step(self, params: Any, state: MeasuredState, u: AnyArray) -> AnyArray:
        """Inputs behind the lag (B, nu)."""
        xp = namespace(u)
        before = state.m if self.past_inputs else xp.where(state.first, u, state.m)
        return before + (1.0 - xp.exp(-self.sampling_time / xp.exp(params["log_lag"]))) * (
            u - before
        )

    def parameters(self, params: Any) -> dict[str, float]:
        """Time constants by name."""
        lags = np.exp(np.asarray(params["log_lag"], np.float64)).ravel()
        return {f"lag {k} [s]": float(lag) for k, lag in enumerate(lags, 1)}


@dataclass(frozen=True)
class Disturbance:
    """Bounded disturbance that opposes the acceleration at the start, then the mean one."""

    sampling_time: float  # In s

    def step(
        self, params: Any, state: MeasuredState, total: AnyArray, extra: AnyArray
    ) -> tuple[AnyArray, AnyArray]:
        """Learned rates (B, nd) with the disturbance, and the next disturbance. total, extra (B,
        nd): rates of the equations and learned rates, in units of the measured ones."""
        xp = namespace(total)
        bound = xp.exp(params["d_bound"])
        d = xp.where(state.first, -params["d_start"] * (total + extra), state.d)
        extra = extra + bound * xp.tanh(d / bound)
        pull = params["d_gain"] * (total + extra) + params["d_decay"] * d
        return extra, d - self.sampling_time * pull


@dataclass(frozen=True)
class TermNetwork:
    """Network whose outputs are learned terms; it can read signals under symmetries."""

    kind: NetworkKind  # Kind of the layers
    recurrent: recurrent.Config | None  # Layers of a recurrent network
    size: float
    """Its largest effect, as a share of the rates measured, or of the scale of a correction."""
    reach: float = 3.0
    """Inputs are bounded to this many deviations: beyond, the output stays that at the bound."""
    driving: tuple[int, ...] = ()
    """Places, among its inputs, of signals that the inputs of the system alone make; it reads their
    change and running mean too."""
    symmetric: bool = False  # Whether it sees its signals under the symmetries of the problem

    def initial(self, params: Any, x: AnyArray) -> tuple[Any, Any]:
        """State of the layers, and of the signals that the inputs make, before the first sample."""
        xp = namespace(x)

        def zeros(rows: int, columns: int) -> AnyArray:
            return xp.zeros((rows, columns), x.dtype)

        h, seen, rows = (), (), len(x)
        if self.recurrent is not None:
            turns = len(params["fixed"]["turns"]) if self.symmetric else 1
            blank = zeros(rows * turns, self.recurrent.hidden)
            h = [(blank, blank) for _ in range(self.recurrent.layers)]
        if self.driving:
            n = len(self.driving)
            seen = (zeros(rows, n), zeros(rows, n), zeros(rows, 1))
        return h, seen

    def step(self, params: Any, state: MeasuredState, v: AnyArray) -> tuple[AnyArray, Any, Any]:
        """Learned terms from normalised signals v (B, n), and the next two states as `initial`."""
        fixed, rows, seen = params["fixed"], len(v), ()
        if self.driving:
            # Change since the last sample and running mean of what the inputs alone make.
            xp = namespace(v)
            now = v[:, np.array(self.driving)]
            before, total, count = state.seen
            change = _CHANGE * (now - xp.where(state.first, now, before))
            total, count = total + now, count + 1.0
            mean = _MEAN * total / (count + _MEAN_SAMPLES)
            v, seen = xp.concatenate([v, change, mean], axis=-1), (now, total, count)
        if not self.symmetric:
            v, h = self._evaluate(params, state, v)
        elif len(state.turn):
            v, h = self._evaluate(
                params, state, (fixed["turns"][state.turn] * v[:, None]).sum(axis=-1)
            )
            v = (fixed["turns_back"][state.turn] * v[:, None]).sum(axis=-1)
        else:
            v, h = self._evaluate(
                params, state, (v @ fixed["turns"].swapaxes(1, 2)).reshape(-1, v.shape[-1])
            )
            v = (v.reshape(-1, rows, v.shape[-1]) @ fixed["turns_back"].swapaxes(1, 2)).mean(axis=0)
        return v, h, seen

    def drawn(self, params: Any, state: MeasuredState, key: AnyArray) -> MeasuredState:
        """The state with one symmetry drawn for each row."""
        import jax

        turns, rows = len(params["fixed"]["turns"]), len(state.x)
        h = jax.tree.map(lambda v: v[:rows], state.h)
        return state._replace(h=h, turn=jax.random.randint(key, (rows,), 0, turns))

    def _evaluate(self, params: Any, state: MeasuredState, v: AnyArray) -> tuple[AnyArray, Any]:
        """Outputs of the network, and the next state of its layers."""
        xp, h, net = namespace(v), state.h, params["net"]
        v = self.reach * xp.tanh(v / self.reach)
        if self.recurrent is None:
            v = xp.tanh(xp.tanh(v @ net["w1"] + net["b1"]) @ net["w2"] + net["b2"])
        else:
            if "start_w" in params:
                start = xp.tanh(v @ params["start_w"])
                first = xp.concatenate([state.first] * (len(v) // len(state.first)))
                h = [(xp.where(first, start, a), c) for a, c in h]
            h, v = recurrent.RecurrentCell(self.recurrent).step(net, h, v)
        return self.size * (v @ params["out_w"] + params["out_b"]), h


@dataclass(frozen=True)
class MeasuredCell:
    """Structure of the model: see `asia.models._networks.structure.Cell`. Hashable."""

    physics: MeasuredEquations  # Equations from the problem file
    read: tuple[str, ...]  # States and definitions that the learned terms may read
    sampling_time: float  # In s
    past_inputs: bool  # Whether a past window shows inputs
    lag: InputLag | None  # Lag through which the inputs act
    gain: bool  # Whether known kinematics get a learned factor
    linear: bool  # Whether there are linear terms
    disturbance: Disturbance | None  # Disturbance of the rates
    network: TermNetwork | None  # Network for what is left
    delay: bool = False  # Whether known kinematics read the other states at a learned delay
    ridge: float = 0.0  # Weight of the squared linear terms against the loss of a network method
    prior_weight: float = 0.0  # Weight of the squared deviations from the priors against the loss

    @property
    def net_inputs(self) -> int:
        """Signals the network reads: those of `read`, and with corrections changes and means of
        some, else the inputs and the equations' rates."""
        if self.physics.corrections:
            return len(self.read) + 2 * len(self.network.driving if self.network else ())
        return len(self.read) + len(self.physics.system.inputs) + self.physics.nd

    def parameters(self, params: Any) -> dict[str, float]:
        """Physical parameters of the equations, and the lags of the inputs in s."""
        lags = {} if self.lag is None else self.lag.parameters(params)
        return self.physics.parameters(params["physical"]) | lags

    def initial(self, params: Any, window: AnyArray) -> MeasuredState:
        """State from the last measured outputs, and from the last measured inputs where there are
        any."""
        fixed, xp = params["fixed"], namespace(window)
        ny, nu = len(self.physics.order), len(self.physics.system.inputs)
        y = window[:, window.shape[1] - ny :] * fixed["y_std"] + fixed["y_mean"]
        x = y[:, np.array(self.physics.order)]
        m, d = (xp.zeros((len(x), n), x.dtype) for n in (nu, self.physics.nd))
        if self.past_inputs:
            last = window.shape[1] - ny - nu
            m = window[:, last : last + nu] * fixed["u_std"] + fixed["u_mean"]
        h, seen = ((), ()) if self.network is None else self.network.initial(params, x)
        return MeasuredState(x, m, d, h, xp.ones((len(x), 1), bool), seen=seen)

    def step(
        self, params: Any, state: MeasuredState, u: AnyArray
    ) -> tuple[MeasuredState, AnyArray]:
        """Advance by one sample; the output is read from the z-scored output."""
        fixed, dt, xp, physics = params["fixed"], self.sampling_time, namespace(u), self.physics
        u = u * fixed["u_std"] + fixed["u_mean"]
        m = u if self.lag is None else self.lag.step(params, state, u)
        p = physics.physical(params["physical"])
        evaluate, inputs = physics.system.rates(xp, u.dtype), m.T
        effects, h, seen = None, state.h, state.seen
        if physics.corrections:
            effects, h, seen = self._corrected(params, p, state, u)

        def rates(x: AnyArray) -> AnyArray:
            free = p if effects is None else [*p, *effects.T]
            return evaluate(free, x.T, inputs).T

        known = rates(state.x)
        total = known[:, np.array(physics.dynamic, int)] / fixed["rate"]
        learned, d = xp.zeros_like(total), state.d
        if effects is None:
            learned, h, seen = self._added(params, p, state, m, total)
        if self.disturbance is not None:
            learned, d = self.disturbance.step(params, state, total, learned)
        learned = learned * fixed["rate"]
        gain: AnyArray = 1.0
        if self.gain and physics.kinematic:
            gain = physics.in_state_order(1.0 + params["gain"], xp.ones_like(learned[0]))
        blank = xp.zeros_like(known[:, physics.nd :])
        if (physics.corrections or self.delay) and physics.kinematic:
            # The driven states move first, and the known kinematics read them halfway.
            known = known[:, np.array(physics.dynamic, int)]
            moved = known + learned
            ahead = 0.5 * dt * moved
            if self.delay:
                ahead = ahead + _DELAY_SAMPLES * dt * params["delay"] * known
            others = rates(state.x + physics.in_state_order(blank, ahead))
            others = others[:, np.array(physics.kinematic, int)]
            x = state.x + dt * gain * physics.in_state_order(others, moved)
        else:
            extra = physics.in_state_order(blank, learned)
            middle = state.x + 0.5 * dt * (gain * known + extra)
            x = state.x + dt * (gain * rates(middle) + extra)
        x = xp.where(xp.isfinite(x), x, state.x)
        x = xp.minimum(xp.maximum(x, fixed["x_low"]), fixed["x_high"])
        y = (x[:, np.argsort(physics.order)] - fixed["y_mean"]) / fixed["y_std"]
        return MeasuredState(x, m, d, h, xp.zeros_like(state.first), state.turn, seen), y

    def output(self, params: Any, features: AnyArray, u: AnyArray) -> AnyArray:
        """Output: the features."""
        del params, u
        return features

    def feed(self, params: Any, state: MeasuredState, y: AnyArray, mask: AnyArray) -> MeasuredState:
        """Replace the outputs in the state by the measured ones, z-scored, where the mask is 1."""
        fixed = params["fixed"]
        measured = (y * fixed["y_std"] + fixed["y_mean"])[:, np.array(self.physics.order)]
        return state._replace(x=mask * measured + (1 - mask) * state.x)

    def drawn(self, params: Any, state: MeasuredState, key: AnyArray) -> MeasuredState:
        """The state with one symmetry drawn for each row."""
        if self.network is None or not self.network.symmetric:
            return state
        return self.network.drawn(params, state, key)

    def penalty(self, params: Any) -> AnyArray:
        """Ridge of the linear terms, and weighted deviations from the priors."""
        total: AnyArray = 0.0
        if self.ridge and self.linear:
            total = self.ridge * ((params["linear"] ** 2).sum() + (params["offset"] ** 2).sum())
        if self.physics.priors and self.prior_weight:
            deviations = self.physics.deviations(params["physical"])
            total = total + self.prior_weight * (deviations**2).sum()
        return total

    def _added(
        self, params: Any, p: AnyArray, state: MeasuredState, m: AnyArray, total: AnyArray
    ) -> tuple[AnyArray, Any, Any]:
        """Learned rates (B, nd) in units of the measured ones, and the next states of the
        network."""
        fixed, xp = params["fixed"], namespace(total)
        signals = self._signals(params, p, state.x, m)
        extra, h, seen = xp.zeros_like(total), state.h, state.seen
        if self.linear:
            extra = extra + params["offset"] + signals @ params["linear"]
        if self.network is not None:
            inputs = (m - fixed["u_mean"]) / fixed["u_std"]
            together = xp.concatenate([signals, inputs, total + extra], axis=-1)
            v, h, seen = self.network.step(params, state, together)
            extra = extra + v
        return extra, h, seen

    def _corrected(
        self, params: Any, p: AnyArray, state: MeasuredState, u: AnyArray
    ) -> tuple[AnyArray, Any, Any]:
        """Values of the corrections (B, nc), and the next states of the network."""
        fixed, h, seen = params["fixed"], state.h, state.seen
        extra = namespace(u).zeros((len(u), self.physics.nc), u.dtype)
        if self.linear:
            signals = self._signals(params, p, state.x, u)
            extra = extra + params["offset"] + signals @ params["linear"]
        if self.network is not None:
            values = self.physics.named(self.read, p, state.x, u)
            normalised = (values - fixed["w_mean"]) / fixed["w_std"]
            v, h, seen = self.network.step(params, state, normalised)
            extra = extra + v
        return extra * fixed["scale"], h, seen

    def _signals(self, params: Any, p: AnyArray, x: AnyArray, m: AnyArray) -> AnyArray:
        """Normalised signals (B, len(read))."""
        values = self.physics.named(self.read, p, x, m)
        return (values - params["fixed"]["s_mean"]) / params["fixed"]["s_std"]


# Constants of a cell of measured states, from the records, the problem, and validation scores.

# Deviations of a state beyond which a simulation has diverged.
_FAR = 30.0
_RATE_SAMPLES = 5
# Weak prior that draws parameters to the middle of their ranges, in half ranges over deviations of
# a prior.
_WEAK = 0.01


def measured_sizes(
    cell: MeasuredCell, trajectories: Sequence[Trajectory], scaling: Scaling, context: Context
) -> dict[str, Any]:
    """Sizes of all signals, which no method changes: `params["fixed"]` of the cell."""
    physics, network = cell.physics, cell.network
    order = list(physics.order)
    assert context.physics is not None
    # Bounds that keep a simulation finite, and the physical ones.
    far = _FAR * scaling.y_std[order]
    low, high = scaling.y_mean[order] - far, scaling.y_mean[order] + far
    bounds = [context.physics.bounds.get(name, Bounds()) for name in physics.system.states]
    low = np.maximum(low, [-np.inf if b.min is None else b.min for b in bounds])
    high = np.minimum(high, [np.inf if b.max is None else b.max for b in bounds])
    span = _RATE_SAMPLES
    moved = np.concatenate([t.y[span:] - t.y[:-span] for t in trajectories])
    rate = moved[:, order].std(axis=0) / (span * context.sampling_time)
    rate = np.where(rate > 0, rate, 1.0)[list(physics.dynamic)]
    # Sizes of the signals that the learned terms may read, at the middle of the parameter ranges.
    every = max(1, sum(len(t) for t in trajectories) // 2000)
    y = np.concatenate([t.y[::every] for t in trajectories])[:, order]
    u = np.concatenate([t.u[::every] for t in trajectories])
    signals = physics.named(cell.read, physics.physical(np.zeros(len(physics.ranges))), y, u)
    mean, std = signals.mean(axis=0), signals.std(axis=0)
    std = np.where(std > 0, std, 1.0)
    values: dict[str, Array] = {
        "y_mean": scaling.y_mean,
        "y_std": scaling.y_std,
        "u_mean": scaling.u_mean,
        "u_std": scaling.u_std,
        "x_low": low,
        "x_high": high,
        "rate": rate,
        "s_mean": mean,
        "s_std": std,
    }
    if physics.corrections:
        # Sizes of the network's inputs and of the corrections, the same for signals that a symmetry
        # exchanges, and the symmetries as matrices.
        symmetric = network is not None and network.symmetric
        driving = () if network is None else network.driving
        turns = group(context.symmetry if symmetric else {}, (*cell.read, *physics.corrections))
        n = len(cell.read)
        seen = [*range(n), *driving, *driving]
        # Parts of what the network reads: no symmetry takes one to another.
        part = np.repeat([0, 1, 2], [n, len(driving), len(driving)])
        own, places = turns[:, :n, :n], turns[:, n:, n:]
        scale = np.array([c.scale for c in context.physics.corrections.values()])
        values |= {
            "w_mean": (own @ mean).mean(axis=0),
            "w_std": np.sqrt((np.abs(own) @ std**2).mean(axis=0)),
            "scale": np.sqrt((np.abs(places) @ scale**2).mean(axis=0)),
            "turns": turns[:, seen][:, :, seen] * np.equal.outer(part, part),
            "turns_back": places.swapaxes(1, 2),
        }
    return {k: np.asarray(v, np.float32) for k, v in values.items()}


def outputs_of_states(system: Equations, context: Context) -> dict[str, int]:
    """Number of the output that is each state.

    Raises:
        UserError: if a state has no such output.
    """
    shown = {e.root.name: k for k, e in enumerate(system.observation) if isinstance(e.root, Name)}
    missing = [s for s in system.states if s not in shown]
    if missing or context.n_past_y < 1 or len(shown) != len(system.outputs):
        raise UserError(
            f"physics_net: the past window must show every state as it is, and does not show "
            f"{', '.join(missing) or 'any'}; use greybox"
        )
    return shown


def readable_signals(given: Equations, system: Equations, context: Context) -> tuple[str, ...]:
    """Signals that learned terms may read.

    They are definitions without fitted parameters, and the states that the equations read. Terms at
    corrections read inputs too, and where there are symmetries only states and inputs that these
    name.
    """
    used = frozenset[str]().union(*(system.closure(e) for e in system.dynamics))
    fitted = set(system.parameters)
    definitions = [n for n, e in given.definitions if not system.closure(e) & fitted]
    plain = [s for s in system.states if s in used]
    if system.parameters != given.parameters:
        plain += system.inputs
        if context.symmetry:
            named = {n for generator in context.symmetry.values() for n in generator}
            plain = [n for n in (*system.states, *system.inputs) if n in named]
    return (*plain, *definitions)


def made_by_inputs(system: Equations, name: str) -> bool:
    """Return whether a signal depends on inputs and on no state."""
    found = {name}
    for own, expression in system.definitions:
        if own == name:
            found = system.closure(expression)
    return bool(set(found) & set(system.inputs)) and not set(found) & set(system.states)


def most_probable(cell: MeasuredCell) -> Float32:
    """Coordinates of the parameters, in the middle of the ranges but for what priors say."""
    z = np.zeros(len(cell.physics.ranges))
    if cell.physics.priors:
        from scipy.optimize import least_squares  # loading takes long

        z = least_squares(lambda z: np.append(cell.physics.deviations(z), _WEAK * z), z).x
    return z.astype(np.float32)


def single_precision(params: Params) -> dict[str, Any]:
    """Convert parameters to float32, as networks use it."""
    return cast_tree(params, np.float32)


class LimitedScore:
    """Validation score of parameters, `most` times; after that nothing is better."""

    def __init__(self, oracle: Callable[[Model], float], network: NetworkModel, most: int) -> None:
        self._oracle, self._network, self._most = oracle, network, most
        self.asked = 0

    def __call__(self, params: Params) -> float:
        if self.asked >= self._most:
            return float("inf")
        self.asked += 1
        own = single_precision({**self._network.params, **params})
        return self._oracle(replace(self._network, params=own))


# Outputs that are rates of change of others, found by the equations or by the records.


@dataclass(frozen=True)
class Rate:
    """Relation of two outputs: d/dt of one is gain times the other."""

    output: int  # Number of the output that is differentiated
    rate: int  # Number of the output that is its rate
    gain: float  # Factor on the rate; 1 where the equations give the relation


def find_rates(trajectories: Sequence[Trajectory], context: Context) -> tuple[Rate, ...]:
    """Find at most one rate for each output, in the outputs' order, never in a circle.

    An equation of [physics] without free parameters, of a state that is an output, has
    as rate the output it names or, if it holds more than a name, the one of those it reads whose
    integral over the horizon fits best the output's increment, at a correlation above 0.6.
    Where [physics] has no such equation, every other output is tried, with a gain between 2/3 and
    3/2.
    """
    shortest = min(len(t) for t in trajectories)
    fit = motion(trajectories, min(context.horizon or 100, max(1, shortest // 2)))
    rates: list[Rate] = []
    if context.physics is not None:
        system = _system(context)
        shown = {
            e.root.name: j for j, e in enumerate(system.observation) if isinstance(e.root, Name)
        }
        for state, equation in zip(system.states, system.dynamics, strict=True):
            read = system.closure(equation)
            if state not in shown or read & set(system.parameters):
                continue
            others = {name: shown[name] for name in sorted(read - {state}) if name in shown}
            if isinstance(equation.root, Name) and equation.root.name in others:
                rates.append(Rate(shown[state], others[equation.root.name], 1.0))
            else:
                rates.extend(_best(shown[state], list(others.values()), fit))
        rates.sort(key=lambda r: r.output)
    if not rates:
        everything = range(context.ny)
        rates = [r for j in everything for r in _best(j, everything, fit, LARGEST_GAIN)]
    # Remove the weakest of any rates that lead from an output back to itself.
    kept: dict[int, Rate] = {}
    for rate in sorted(rates, key=lambda r: -fit.correlation[r.output, r.rate]):
        end = rate.rate
        while end in kept:
            end = kept[end].rate
        if end != rate.output:
            kept[rate.output] = rate
    return tuple(kept[j] for j in sorted(kept))


def read_by_equations(context: Context) -> frozenset[int]:
    """Outputs that show a state which some equation of [physics] reads; all without [physics]."""
    if context.physics is None:
        return frozenset(range(context.ny))
    system = _system(context)
    read = frozenset[str]().union(*(system.closure(e) for e in system.dynamics))
    shown = [e.root.name if isinstance(e.root, Name) else None for e in system.observation]
    return frozenset(j for j, state in enumerate(shown) if state is None or state in read)


def _system(context: Context) -> Equations:
    assert context.physics is not None
    names = [s.name for s in context.inputs], [s.name for s in context.outputs]
    return equations(context.physics, *names)


def _best(
    j: int, candidates: Sequence[int], fit: Motion, largest: float | None = None
) -> tuple[Rate, ...]:
    """Rate of output j with the highest correlation, if there is one; `largest` bounds the gain and
    its inverse."""
    able = [
        i
        for i in candidates
        if i != j
        and fit.correlation[j, i] > LEAST_CORRELATION
        and (largest is None or 1 / largest < fit.gain[j, i] < largest)
    ]
    if not able:
        return ()
    best = max(able, key=lambda i: fit.correlation[j, i])
    return (Rate(j, best, float(fit.gain[j, best])),)
