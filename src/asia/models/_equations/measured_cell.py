"""State-space step of equations whose states are all measured, with learned terms, batch first.

    dx/dt = gain f(x, m) + gain rate (offset + linear' s + d + net),   dm/dt = (u - m) / lag

The learned terms act on the equations with free parameters; gain is 1 + `gain` in the others
(known kinematics) and 1 in these. s are normalised states and definitions that the
equations read; d, bounded, is a disturbance that opposes the acceleration at the start and then
the mean acceleration; net is a network. Everything learned is without effect at zero.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np

from asia.models import recurrent
from asia.models._arrays import AnyArray, namespace
from asia.models._equations.config import Range
from asia.models._equations.ode import Equations
from asia.models._equations.simulate import physical_parameters

NetworkKind = Literal["mlp", "rnn", "gru", "lstm"]

# Number of zero samples assumed before the first one in running means, and units of changes and
# means in deviations of the signal.
_MEAN_SAMPLES = 10.0
_CHANGE, _MEAN = 2.5, 2.0
# Unit of learned delays, in samples.
_DELAY_SAMPLES = 5.0


class MeasuredState(NamedTuple):
    """State of the model before one sample, batch first."""

    x: AnyArray
    """States (B, nx)."""
    m: AnyArray
    """Inputs behind their lag (B, nu)."""
    d: AnyArray
    """Disturbance (B, nd)."""
    h: Any
    """State of the network."""
    first: AnyArray
    """No sample has been simulated yet (B, 1)."""
    turn: Any = ()
    """Number of the transformation under which the network sees each row (B,); () is all of them,
    averaged."""
    seen: Any = ()
    """Memory of the signals that depend only on inputs: the last values (B, n), the sum and the
    number
    of their samples."""


@dataclass(frozen=True)
class MeasuredCell:
    """Structure of the model: see `asia.models._networks.structure.Cell`. Hashable."""

    equations: Equations
    """Equations from the problem file."""
    ranges: tuple[Range, ...]
    """Search ranges of their parameters."""
    order: tuple[int, ...]
    """Number of the output that shows each state."""
    dynamic: tuple[int, ...]
    """Equations with free parameters."""
    kinematic: tuple[int, ...]
    """Equations without free parameters, if these get a gain; else none."""
    read: tuple[str, ...]
    """States and definitions that the learned terms may read."""
    sampling_time: float
    """Sampling time in s."""
    past_inputs: bool
    """A past window holds inputs."""
    lag: bool
    """The inputs act through a lag."""
    linear: bool
    """The model has linear terms."""
    disturbance: bool
    """The model has a disturbance state."""
    network: NetworkKind | None
    """Kind of the network, if there is one."""
    inner: recurrent.Config | None
    """Layers of a recurrent network."""
    size: float
    """Largest effect of the network, as a share of the rates measured, or of the scale of a
    correction."""
    reach: float = 3.0
    """Inputs of the network are bounded to this many deviations: beyond, its output stays that at
    the bound."""
    corrections: tuple[str, ...] = ()
    """Places in the equations where the learned terms enter; none: on the rates."""
    driving: tuple[str, ...] = ()
    """Signals of `read` that depend only on inputs; with corrections the network also reads their
    change and running mean."""
    symmetric: bool = False
    """The network sees its signals under the symmetries of the problem."""
    ridge: float = 0.0
    """Weight of the squared linear terms against the loss of a network method."""
    delay: bool = False
    """Known kinematics read the other states at a learned delay."""
    priors: tuple[tuple[str, float, float], ...] = ()
    """Prior knowledge of the parameters: definition of the equations, mean and deviation."""
    prior_weight: float = 0.0
    """Weight of the squared deviations against the loss."""

    @property
    def nc(self) -> int:
        """Number of places where learned terms enter."""
        return len(self.corrections) or self.nd

    @property
    def nd(self) -> int:
        """Number of equations with learned terms."""
        return len(self.dynamic)

    @property
    def _others(self) -> tuple[int, ...]:
        """Equations without free parameters."""
        return tuple(i for i in range(len(self.order)) if i not in self.dynamic)

    @property
    def semi_implicit(self) -> bool:
        """The driven states move first, and the known kinematics read them halfway."""
        return bool(self.corrections or self.delay) and len(self.dynamic) < len(self.order)

    @property
    def net_inputs(self) -> int:
        """Number of signals that the network reads: those of `read`, and with corrections changes
        and means of some, else the inputs and the equations' rates."""
        if self.corrections:
            return len(self.read) + 2 * len(self.driving)
        return len(self.read) + len(self.equations.inputs) + self.nd

    def physical(self, z: AnyArray) -> AnyArray:
        """Physical parameters (np,) from coordinates in which [-1, 1] spans their ranges."""
        return physical_parameters(self.ranges, z)

    def parameters(self, params: Any) -> dict[str, float]:
        """Parameters of the equations in their physical units, and the lags of the inputs in s."""
        values = np.asarray(self.physical(params["physical"]), np.float64)
        names = self.equations.parameters[: len(self.ranges)]
        found = {name: float(value) for name, value in zip(names, values, strict=True)}
        if self.lag:
            lags = np.exp(np.asarray(params["log_lag"], np.float64)).ravel()
            found |= {f"lag {k} [s]": float(lag) for k, lag in enumerate(lags, 1)}
        return found

    def initial(self, params: Any, window: AnyArray) -> MeasuredState:
        """State from the last measured outputs, and from the last measured inputs where there are
        any."""
        fixed, xp = params["fixed"], namespace(window)
        ny, nu = len(self.order), len(self.equations.inputs)
        y = window[:, window.shape[1] - ny :] * fixed["y_std"] + fixed["y_mean"]
        x = y[:, np.array(self.order)]

        def zeros(columns: int) -> AnyArray:
            return xp.zeros((len(x), columns), x.dtype)

        m = zeros(nu)
        if self.past_inputs:
            last = window.shape[1] - ny - nu
            m = window[:, last : last + nu] * fixed["u_std"] + fixed["u_mean"]
        h: Any = ()
        if self.inner is not None:
            rows = len(x) * (len(fixed["turns"]) if self.symmetric else 1)
            blank = xp.zeros((rows, self.inner.hidden), x.dtype)
            h = [(blank, blank) for _ in range(self.inner.layers)]
        first, seen = xp.ones((len(x), 1), bool), ()
        if self.driving and self.network is not None:
            seen = (zeros(len(self.driving)), zeros(len(self.driving)), zeros(1))
        return MeasuredState(x, m, zeros(self.nd), h, first, seen=seen)

    def step(
        self, params: Any, state: MeasuredState, u: AnyArray
    ) -> tuple[MeasuredState, AnyArray]:
        """Advance by one sample; the features are the output, z-scored."""
        fixed, dt, xp = params["fixed"], self.sampling_time, namespace(u)
        u = u * fixed["u_std"] + fixed["u_mean"]
        m = u
        if self.lag:
            before = state.m if self.past_inputs else xp.where(state.first, u, state.m)
            m = before + (1.0 - xp.exp(-dt / xp.exp(params["log_lag"]))) * (u - before)
        p = self.physical(params["physical"])
        evaluate, inputs = self.equations.rates(xp, u.dtype), m.T
        effects, h, seen = None, state.h, state.seen
        if self.corrections:
            effects, h, seen = self._corrected(params, p, state, u)

        def rates(x: AnyArray) -> AnyArray:
            free = p if effects is None else [*p, *effects.T]
            return evaluate(free, x.T, inputs).T

        known = rates(state.x)
        if effects is None:
            learned, d, h = self._learned(params, p, state, m, known)
        else:
            learned, d = self._opposed(params, state, known, xp.zeros_like(known[:, : self.nd]))
        gain: AnyArray = 1.0
        if self.kinematic:
            gain = self._in_order(1.0 + params["gain"], xp.ones_like(learned[0]))
        blank = xp.zeros_like(known[:, self.nd :])
        if self.semi_implicit:
            known = known[:, np.array(self.dynamic, int)]
            moved = known + learned
            ahead = 0.5 * dt * moved
            if self.delay:
                ahead = ahead + _DELAY_SAMPLES * dt * params["delay"] * known
            others = rates(state.x + self._in_order(blank, ahead))
            others = others[:, np.array(self._others, int)]
            x = state.x + dt * gain * self._in_order(others, moved)
        else:
            extra = self._in_order(blank, learned)
            middle = state.x + 0.5 * dt * (gain * known + extra)
            x = state.x + dt * (gain * rates(middle) + extra)
        x = xp.where(xp.isfinite(x), x, state.x)
        x = xp.minimum(xp.maximum(x, fixed["x_low"]), fixed["x_high"])
        y = (x[:, np.argsort(self.order)] - fixed["y_mean"]) / fixed["y_std"]
        return MeasuredState(x, m, d, h, xp.zeros_like(state.first), state.turn, seen), y

    def _in_order(self, others: AnyArray, dynamic: AnyArray) -> AnyArray:
        """Values (..., nx) in the order of the states, from those of the other equations (in their
        order) and of the dynamic ones."""
        places = [*self._others, *self.dynamic]
        together = namespace(others, dynamic).concatenate([others, dynamic], axis=-1)
        return together[..., np.argsort(places)]

    def output(self, params: Any, features: AnyArray, u: AnyArray) -> AnyArray:
        """Output: the features."""
        del params, u
        return features

    def feed(self, params: Any, state: MeasuredState, y: AnyArray, mask: AnyArray) -> MeasuredState:
        """Replace the outputs in the state by the measured ones, z-scored, where the mask is 1."""
        fixed = params["fixed"]
        measured = (y * fixed["y_std"] + fixed["y_mean"])[:, np.array(self.order)]
        return state._replace(x=mask * measured + (1 - mask) * state.x)

    def signals(self, params: Any, p: AnyArray, x: AnyArray, m: AnyArray) -> AnyArray:
        """Normalised signals (B, len(read))."""
        values = self.equations.named(self.read, self._given(p), x.T, m.T).T
        return (values - params["fixed"]["s_mean"]) / params["fixed"]["s_std"]

    def _given(self, p: AnyArray) -> AnyArray:
        """Arguments of the equations as given: the parameters, and corrections of 0."""
        if not self.corrections:
            return p
        return namespace(p).concatenate([p, np.zeros(self.nc, p.dtype)])

    def _learned(
        self, params: Any, p: AnyArray, state: MeasuredState, m: AnyArray, known: AnyArray
    ) -> tuple[AnyArray, AnyArray, Any]:
        """Learned rates (B, nd), next disturbance, next state of the network."""
        fixed, xp = params["fixed"], namespace(known)
        total = known[:, np.array(self.dynamic, int)] / fixed["rate"]
        signals = self.signals(params, p, state.x, m)
        extra = xp.zeros_like(total)
        if self.linear:
            extra = extra + params["offset"] + signals @ params["linear"]
        h = state.h
        if self.network is not None:
            inputs = (m - fixed["u_mean"]) / fixed["u_std"]
            h, v = self._network(
                params, h, xp.concatenate([signals, inputs, total + extra], axis=-1)
            )
            extra = extra + v
        rates, d = self._opposed(params, state, known, extra)
        return rates, d, h

    def _opposed(
        self, params: Any, state: MeasuredState, known: AnyArray, extra: AnyArray
    ) -> tuple[AnyArray, AnyArray]:
        """Learned rates (B, nd) from those in units of the rates measured, and the next
        disturbance."""
        fixed, xp, d = params["fixed"], namespace(known), state.d
        if self.disturbance:
            total = known[:, np.array(self.dynamic, int)] / fixed["rate"]
            bound = xp.exp(params["d_bound"])
            d = xp.where(state.first, -params["d_start"] * (total + extra), d)
            extra = extra + bound * xp.tanh(d / bound)
            pull = params["d_gain"] * (total + extra) + params["d_decay"] * d
            d = d - self.sampling_time * pull
        return extra * fixed["rate"], d

    def _network(self, params: Any, h: Any, v: AnyArray) -> tuple[Any, AnyArray]:
        """Next state of the network, and its effect."""
        xp = namespace(v)
        v = self._bounded(v)
        if self.network == "mlp":
            net = params["net"]
            v = xp.tanh(xp.tanh(v @ net["w1"] + net["b1"]) @ net["w2"] + net["b2"])
        else:
            assert self.inner is not None
            h, v = recurrent.RecurrentCell(self.inner).step(params["net"], h, v)
        return h, self.size * (v @ params["out_w"] + params["out_b"])

    def _corrected(
        self, params: Any, p: AnyArray, state: MeasuredState, u: AnyArray
    ) -> tuple[AnyArray, Any, Any]:
        """Values of the corrections (B, nc), the next state of the network, and its memory of
        signals."""
        fixed, xp = params["fixed"], namespace(u)
        extra = xp.zeros((len(u), self.nc), u.dtype)
        if self.linear:
            extra = (
                extra + params["offset"] + self.signals(params, p, state.x, u) @ params["linear"]
            )
        h, seen = state.h, state.seen
        if self.network is not None:
            values = self.equations.named(self.read, self._given(p), state.x.T, u.T).T
            v = (values - fixed["w_mean"]) / fixed["w_std"]
            v, seen = self._remembered(state, v)
            if not self.symmetric:
                h, v = self._network(params, self._begun(params, state, h, v), v)
            elif len(state.turn):
                turned = (fixed["turns"][state.turn] * v[:, None]).sum(axis=-1)
                h, v = self._network(params, self._begun(params, state, h, turned), turned)
                v = (fixed["turns_back"][state.turn] * v[:, None]).sum(axis=-1)
            else:
                turned = (v @ fixed["turns"].swapaxes(1, 2)).reshape(-1, v.shape[-1])
                h, v = self._network(params, self._begun(params, state, h, turned), turned)
                v = (v.reshape(-1, len(u), self.nc) @ fixed["turns_back"].swapaxes(1, 2)).mean(
                    axis=0
                )
            extra = extra + v
        return extra * fixed["scale"], h, seen

    def _remembered(self, state: MeasuredState, v: AnyArray) -> tuple[AnyArray, Any]:
        """Inputs of the network and its memory for the next sample.

        The inputs are the signals v (B, n), and of those that depend only on inputs the change
        since the last sample and the running mean.
        """
        if not self.driving:
            return v, ()
        xp = namespace(v)
        now = v[:, np.array([self.read.index(name) for name in self.driving])]
        before, total, count = state.seen
        change = _CHANGE * (now - xp.where(state.first, now, before))
        total, count = total + now, count + 1.0
        mean = _MEAN * total / (count + _MEAN_SAMPLES)
        return xp.concatenate([v, change, mean], axis=-1), (now, total, count)

    def _begun(self, params: Any, state: MeasuredState, h: Any, v: AnyArray) -> Any:
        """State of a recurrent network, before the first sample made from its inputs v."""
        if self.inner is None:
            return h
        xp = namespace(v)
        start = xp.tanh(self._bounded(v) @ params["start_w"])
        first = xp.concatenate([state.first] * (len(v) // len(state.first)))
        return [(xp.where(first, start, a), c) for a, c in h]

    def _bounded(self, v: AnyArray) -> AnyArray:
        return self.reach * namespace(v).tanh(v / self.reach)

    def drawn(self, params: Any, state: MeasuredState, key: AnyArray) -> MeasuredState:
        """State with one transformation drawn for each row."""
        if not self.symmetric:
            return state
        import jax

        turns, rows = len(params["fixed"]["turns"]), len(state.x)
        h = jax.tree.map(lambda v: v[:rows], state.h)
        return state._replace(h=h, turn=jax.random.randint(key, (rows,), 0, turns))

    def penalty(self, params: Any) -> AnyArray:
        """Ridge of the linear terms, and penalty of the priors on the parameters."""
        total: AnyArray = 0.0
        if self.ridge and self.linear:
            total = self.ridge * ((params["linear"] ** 2).sum() + (params["offset"] ** 2).sum())
        if self.priors and self.prior_weight:
            total = total + self.prior_weight * (self.deviations(params["physical"]) ** 2).sum()
        return total

    def deviations(self, z: AnyArray) -> AnyArray:
        """Distances (n,) of the parameters of coordinates z from their priors, in standard
        deviations."""
        names = tuple(name for name, _, _ in self.priors)
        mean, deviation = (np.array(v, z.dtype) for v in list(zip(*self.priors, strict=True))[1:])
        nothing = namespace(z).zeros((0,), z.dtype)
        # Priors contain only parameters and constants, so that states and inputs are empty.
        values = self.equations.named(names, self._given(self.physical(z)), nothing, nothing)
        return (values - mean) / deviation
