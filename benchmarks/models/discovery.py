"""Terms that equations lack: how often the right ones are found, and what it is worth.

    python benchmarks/models/discovery.py [--seeds 3]

Six simulated systems, each given with equations that lack one or two terms (one lacks nothing), at
three levels of noise. Printed for each: in how many seeds exactly the missing terms were found, and
the simulation error on a new record, in deviations of its output, of the equations alone, with a
network added (the hybrid), with the terms found, and with the true equations fitted.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from asia.candidate import Context
from asia.data import Array, Signal, Trajectory
from asia.models import greybox, hybrid
from asia.models._least_squares import LevenbergMarquardt
from asia.problem import ParameterRange, Physics

TIME, LENGTH = 0.1, 600
NOISES = (0.005, 0.02, 0.1)
METHOD = LevenbergMarquardt(iterations=40, starts=2)


@dataclass(frozen=True)
class System:
    """A truth, and equations that lack something of it."""

    name: str
    slope: Callable[[Array, float], Array]
    """d/dt of the states at an input."""
    given: dict[str, str]
    """Right-hand sides with parameters p0, p1, .."""
    lacks: dict[str, str]
    """State -> the terms it lacks, as they are printed."""
    outputs: tuple[str, ...]
    """States that are measured."""


def _mass(force: Callable[[float, float], float]) -> Callable[[Array, float], Array]:
    def slope(x: Array, u: float) -> Array:
        q, v = x
        return np.array([v, 2.0 * u - 0.4 * v - 2.0 * q + force(q, v)])

    return slope


def _reaction(x: Array, u: float) -> Array:
    a, b = x
    return np.array([u - 0.5 * a - 0.8 * a * b, 2.0 * u - 0.7 * b - 0.8 * a * b])


_MASS = {"q": "v", "v": "p0*u - p1*v - p2*q"}
SYSTEMS = (
    System("nothing lacks", _mass(lambda q, v: 0.0), _MASS, {}, ("q",)),
    System("stiffening", _mass(lambda q, v: -1.5 * q**3), _MASS, {"v": "q**3"}, ("q",)),
    System("drag", _mass(lambda q, v: -0.8 * v * abs(v)), _MASS, {"v": "v * abs(v)"}, ("q",)),
    System("not in the library", _mass(lambda q, v: -0.9 * q * q * v), _MASS, {"v": "q**2 * v"},
           ("q",)),
    System("reaction", _reaction, {"a": "u - p0*a - p1*a*b", "b": "2*u - p2*b"}, {"b": "a * b"},
           ("a", "b")),
    System("reaction, a alone measured", _reaction, {"a": "u - p0*a", "b": "2*u - p1*b - p2*a*b"},
           {"a": "a * b"}, ("a",)),
)  # fmt: skip


def record(system: System, seed: int, noise: float) -> Trajectory:
    """Record from rest, the input held over 8 samples."""
    rng = np.random.default_rng(seed)
    low = -2.0 if "v" in system.given else 0.1
    u = np.repeat(rng.uniform(low, 2.0, LENGTH // 8 + 1), 8)[:LENGTH, None]
    states, x, h = list(system.given), np.zeros(2), TIME / 10
    found = np.empty((LENGTH, 2))
    for k, now in enumerate(u[:, 0]):
        found[k] = x
        for _ in range(10):
            k1 = system.slope(x, now)
            k2 = system.slope(x + 0.5 * h * k1, now)
            k3 = system.slope(x + 0.5 * h * k2, now)
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + system.slope(x + h * k3, now))
    y = found[:, [states.index(name) for name in system.outputs]]
    return Trajectory(u, y + noise * y.std(0) * rng.normal(size=y.shape), TIME)


def context_of(system: System, given: dict[str, str]) -> Context:
    """Context with positive parameters in a wide range and terms of any sign."""
    names = [f"p{k}" for k in range(6) if any(f"p{k}" in e for e in given.values())]
    terms = [f"t{k}" for k in range(3) if any(f"t{k}" in e for e in given.values())]
    ranges = {n: ParameterRange(0.05, 10.0) for n in names}
    ranges |= {n: ParameterRange(-5.0, 5.0) for n in terms}
    observation = {f"y_{name}": name for name in system.outputs}
    physics = Physics(tuple(given), given, ranges, observation=observation)
    outputs = tuple(Signal(name) for name in observation)
    return Context((Signal("u"),), outputs, TIME, n_past_u=5, n_past_y=5, physics=physics)


def complete(system: System) -> dict[str, str]:
    """The equations with what they lack."""
    found = dict(system.given)
    for k, (state, text) in enumerate(system.lacks.items()):
        found[state] += f" + t{k} * ({text})"
    return found


def error(model: greybox.GreyBox, new: Trajectory) -> float:
    """Simulation error in deviations of the output, the mean over outputs."""
    y = model.simulate(new.u[None, :5], new.y[None, :5], new.u[None, 5:])[0]
    return float((np.sqrt(((y - new.y[5:]) ** 2).mean(0)) / new.y.std(0)).mean())


def case(system: System, noise: float, seed: int) -> tuple[bool, list[float]]:
    """Return whether exactly the missing terms were found, and the four errors."""
    train, new = record(system, seed, noise), record(system, 1000 + seed, 0.0)
    plain, full = context_of(system, system.given), context_of(system, complete(system))
    terms = greybox.build(greybox.Config(discover=tuple(system.given)), plain)
    found = greybox.train(terms, [train], plain, METHOD)
    named = {k for k in found.parameters() if ": " in k}
    network = hybrid.train(hybrid.build(hybrid.Config(), plain), [train], plain, METHOD)
    known = [
        greybox.train(greybox.build(greybox.Config(), c), [train], c, METHOD) for c in (plain, full)
    ]
    models = (known[0], network, found, known[1])
    return named == {f"{s}: {t}" for s, t in system.lacks.items()}, [error(m, new) for m in models]


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=3)
    seeds = range(parser.parse_args().seeds)
    columns = ("equations", "hybrid", "terms", "truth")
    print(f"{'system':28}{'noise':>7}{'exact':>8}" + "".join(f"{c:>11}" for c in columns))
    for system in SYSTEMS:
        for noise in NOISES:
            exact, errors = zip(*(case(system, noise, seed) for seed in seeds), strict=True)
            row = "".join(f"{v:11.4f}" for v in np.median(errors, axis=0))
            print(f"{system.name:28}{noise:7.3f}{sum(exact):5d}/{len(exact)}{row}", flush=True)


if __name__ == "__main__":
    main()
