"""Constants of a cell of measured states, from the records, the problem, and validation scores."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from asia.candidate import Context, Model
from asia.data import Array, Trajectory
from asia.errors import UserError
from asia.models._data.scaling import Scaling
from asia.models._equations.measured_cell import MeasuredCell
from asia.models._equations.ode import Equations
from asia.models._networks.layers import Float32
from asia.models._networks.network import NetworkModel
from asia.models._networks.structure import Params
from asia.problem import Bounds
from asia.problem.physics.expressions import Name
from asia.problem.symmetry import group

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
    order = list(cell.physics.order)
    low, high = _limits(scaling.y_mean[order], scaling.y_std[order])
    assert context.physics is not None
    bounds = [context.physics.bounds.get(name, Bounds()) for name in cell.physics.system.states]
    low = np.maximum(low, [-np.inf if b.min is None else b.min for b in bounds])
    high = np.minimum(high, [np.inf if b.max is None else b.max for b in bounds])
    span = _RATE_SAMPLES
    moved = np.concatenate([t.y[span:] - t.y[:-span] for t in trajectories])
    rate = moved[:, order].std(axis=0) / (span * context.sampling_time)
    rate = np.where(rate > 0, rate, 1.0)[list(cell.physics.dynamic)]
    mean, std = _signal_sizes(cell, cell.read, trajectories)
    values = {
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
    if cell.physics.corrections:
        values |= _at_corrections(cell, mean, std, context)
    return {k: np.asarray(v, np.float32) for k, v in values.items()}


def _at_corrections(
    cell: MeasuredCell, mean: Array, std: Array, context: Context
) -> dict[str, Array]:
    """Sizes of the network's inputs and of the corrections, and the symmetries as matrices.

    The sizes come from those of the signals and are the same for signals that a symmetry exchanges.
    """
    assert context.physics is not None
    names = (*cell.read, *cell.physics.corrections)
    network = cell.network
    symmetric = network is not None and network.symmetric
    driving = () if network is None else network.driving
    turns = group(context.symmetry if symmetric else {}, names)
    n = len(cell.read)
    seen = [*range(n), *driving, *driving]
    # Of the parts of what the network reads: no symmetry takes one to another.
    part = np.repeat([0, 1, 2], [n, len(driving), len(driving)])
    own, places = turns[:, :n, :n], turns[:, n:, n:]
    together = turns[:, seen][:, :, seen] * np.equal.outer(part, part)

    def alike(turned: Array, size: Array) -> Array:
        return np.sqrt((np.abs(turned) @ size**2).mean(axis=0))

    scale = np.array([c.scale for c in context.physics.corrections.values()])
    return {
        "w_mean": (own @ mean).mean(axis=0),
        "w_std": alike(own, std),
        "scale": alike(places, scale),
        "turns": together,
        "turns_back": places.swapaxes(1, 2),
    }


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
        z = least_squares(lambda z: np.append(cell.physics.deviations(z), _WEAK * z), z).x
    return z.astype(np.float32)


def _limits(mean: Any, std: Any) -> tuple[Any, Any]:
    """Bounds (nx,) that keep a simulation finite."""
    return mean - _FAR * std, mean + _FAR * std


def _signal_sizes(
    cell: MeasuredCell, names: tuple[str, ...], trajectories: Sequence[Trajectory]
) -> tuple[Array, Array]:
    """Mean and standard deviation, (n,) each, of signals of the equations."""
    every = max(1, sum(len(t) for t in trajectories) // 2000)
    y = np.concatenate([t.y[::every] for t in trajectories])[:, list(cell.physics.order)]
    u = np.concatenate([t.u[::every] for t in trajectories])
    p = cell.physics.physical(np.zeros(len(cell.physics.ranges)))
    values = cell.physics.named(names, p, y, u)
    std = values.std(axis=0)
    return values.mean(axis=0), np.where(std > 0, std, 1.0)


def single_precision(params: Params) -> dict[str, Any]:
    """Convert parameters to float32, as networks use it."""

    def single(value: Any) -> Any:
        if isinstance(value, dict):
            return {name: single(part) for name, part in value.items()}
        if isinstance(value, list | tuple):
            return [single(part) for part in value]
        return np.asarray(value, np.float32)

    return single(dict(params))


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
