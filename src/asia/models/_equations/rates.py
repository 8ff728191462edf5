"""Outputs that are rates of change of others, found by the equations or by the records."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from asia.candidate import Context
from asia.data import Trajectory
from asia.data._motion import LARGEST_GAIN, LEAST_CORRELATION, Motion, motion
from asia.models._equations.ode import Equations, equations
from asia.problem.physics.expressions import Name

_LONGEST = 100


@dataclass(frozen=True)
class Rate:
    """Relation of two outputs: d/dt of one is gain times the other."""

    output: int
    """Number of the output that is differentiated."""
    rate: int
    """Number of the output that is its rate."""
    gain: float
    """Factor on the rate; 1 where the equations give the relation."""


def find_rates(trajectories: Sequence[Trajectory], context: Context) -> tuple[Rate, ...]:
    """Find at most one rate for each output, in the outputs' order, never in a circle.

    An equation of [physics] without free parameters, of a state that is an output, has
    as rate the output it names or, if it holds more than a name, the one of those it reads whose
    integral over the horizon fits best the output's increment, at a correlation above 0.6.
    Where [physics] has no such equation, every other output is tried, with a gain between 2/3 and
    3/2.
    """
    fit = _fitted(trajectories, context)
    rates: list[Rate] = []
    if context.physics is not None:
        rates = _by_equations(_system(context), fit)
    if not rates:
        everything = range(context.ny)
        rates = [r for j in everything for r in _best(j, everything, fit, LARGEST_GAIN)]
    return _without_circles(rates, fit)


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


def _by_equations(system: Equations, fit: Motion) -> list[Rate]:
    shown = {e.root.name: j for j, e in enumerate(system.observation) if isinstance(e.root, Name)}
    found: list[Rate] = []
    for state, equation in zip(system.states, system.dynamics, strict=True):
        read = system.closure(equation)
        if state not in shown or read & set(system.parameters):
            continue
        others = {name: shown[name] for name in sorted(read - {state}) if name in shown}
        named = equation.root.name if isinstance(equation.root, Name) else ""
        if named in others:
            found.append(Rate(shown[state], others[named], 1.0))
        else:
            found.extend(_best(shown[state], list(others.values()), fit))
    return sorted(found, key=lambda r: r.output)


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


def _without_circles(rates: Sequence[Rate], fit: Motion) -> tuple[Rate, ...]:
    """Remove the weakest of any rates that lead from an output back to itself."""
    kept: dict[int, Rate] = {}
    for rate in sorted(rates, key=lambda r: -fit.correlation[r.output, r.rate]):
        end = rate.rate
        while end in kept:
            end = kept[end].rate
        if end != rate.output:
            kept[rate.output] = rate
    return tuple(kept[j] for j in sorted(kept))


def _fitted(trajectories: Sequence[Trajectory], context: Context) -> Motion:
    shortest = min(len(t) for t in trajectories)
    span = min(context.horizon or _LONGEST, max(1, shortest // 2))
    return motion(trajectories, span)
