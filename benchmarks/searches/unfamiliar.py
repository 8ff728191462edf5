"""Five kinds of synthetic system that were chosen with no model family in mind."""

from __future__ import annotations

from math import exp, sin, tanh

import numpy as np

from systems import Array, Kind, Response, integrate, levels


def _backlash(rng: np.random.Generator) -> Response:
    """A position servo turns a load through a gear with play; the stiff teeth push back."""
    speed, damping = rng.uniform(4.0, 6.0), rng.uniform(0.6, 0.8)
    play, stiffness = rng.uniform(0.1, 0.2), rng.uniform(60.0, 100.0)
    viscous, back = rng.uniform(3.0, 4.0), rng.uniform(0.05, 0.1)

    def slope(x: list[float], u: list[float]) -> list[float]:
        motor, motor_speed, load, load_speed = x
        twist = motor - load
        torque = stiffness * (twist - min(max(twist, -play), play))
        pull = speed * speed * (u[0] - motor) - 2 * damping * speed * motor_speed
        return [motor_speed, pull - back * torque, load_speed, torque - viscous * load_speed]

    return lambda u: integrate(slope, [0.0] * 4, u, 0.05, 10)[:, 2:3]


def _heat_exchanger(rng: np.random.Generator) -> Response:
    """u1 the flow, u2 the heat. What leaves the pipe entered it one pipe volume before."""
    vessel, pipe = rng.uniform(2.0, 3.0), rng.uniform(4.0, 6.0)
    loss, lag, fine = rng.uniform(0.01, 0.03), rng.uniform(1.0, 2.0), 10

    def slope(x: list[float], u: list[float]) -> list[float]:
        return [(u[1] - u[0] * x[0]) / vessel]

    def respond(u: Array) -> Array:
        held = np.repeat(u, fine, axis=0)
        entering = integrate(slope, [1.0], held, 1.0 / fine, 1)[:, 0]
        time = np.arange(len(held)) / fine
        volume = np.concatenate([[0.0], np.cumsum(held[:-1, 0]) / fine])
        entry = np.interp(volume - pipe, volume, time)
        leaving = np.interp(entry, time, entering) * np.exp(-loss * (time - entry))
        sensor = integrate(
            lambda x, now: [(now[0] - x[0]) / lag], [1.0], leaving[:, None], 1.0 / fine, 1
        )
        return sensor[::fine]

    return respond


def _pendulum(rng: np.random.Generator) -> Response:
    """The outputs are the sine and the cosine of the angle, so that a full turn is no jump."""
    gravity, damping = rng.uniform(3.0, 5.0), rng.uniform(2.0, 3.0)
    gain = gravity * rng.uniform(0.9, 1.1)

    def slope(x: list[float], u: list[float]) -> list[float]:
        return [x[1], gain * u[0] - gravity * sin(x[0]) - damping * x[1]]

    def respond(u: Array) -> Array:
        angle = integrate(slope, [0.0, 0.0], u, 0.1, 8)[:, :1]
        return np.hstack([np.sin(angle), np.cos(angle)])

    return respond


def _stick_slip(rng: np.random.Generator) -> Response:
    """A drive pulls a mass on dry ground by a spring; its speed is set, its force measured."""
    mass, stiffness = rng.uniform(0.8, 1.2), rng.uniform(8.0, 12.0)
    coulomb, extra = rng.uniform(0.8, 1.2), rng.uniform(0.4, 0.6)
    damping, stribeck = rng.uniform(0.5, 0.8), rng.uniform(0.15, 0.25)

    def slope(x: list[float], u: list[float]) -> list[float]:
        stretch, v = x
        dry = (coulomb + extra * exp(-((v / stribeck) ** 2))) * tanh(v / 0.01)
        return [u[0] - v, (stiffness * stretch + damping * (u[0] - v) - dry) / mass]

    def respond(u: Array) -> Array:
        return stiffness * integrate(slope, [0.0, 0.0], u, 0.05, 20)[:, :1]

    return respond


def _neutralisation(rng: np.random.Generator) -> Response:
    """Strong and weak acid meet a strong base; concentrations in mmol/l, pH by charge balance."""
    strong, weak = rng.uniform(2.5, 3.5), rng.uniform(1.5, 2.5)
    volume, base = rng.uniform(5.0, 8.0), 10.0
    dissociation = 10.0 ** -rng.uniform(5.5, 6.5)

    def slope(x: list[float], u: list[float]) -> list[float]:
        flow = 1.0 + u[0]
        feed = [strong, weak, base * u[0]]
        return [(f - flow * v) / volume for f, v in zip(feed, x, strict=True)]

    def respond(u: Array) -> Array:
        acid, buffer, alkali = 1e-3 * integrate(slope, [2.0, 1.4, 3.0], u, 1.0, 2).T
        low, high = np.full(len(u), 0.0), np.full(len(u), 14.0)
        for _ in range(50):
            ph = (low + high) / 2
            h = 10.0**-ph
            charge = h + alkali - 1e-14 / h - acid - buffer * dissociation / (dissociation + h)
            low, high = np.where(charge > 0, ph, low), np.where(charge > 0, high, ph)
        return ((low + high) / 2)[:, None]

    return respond


def _flow_and_heat(rng: np.random.Generator, samples: int) -> Array:
    flow = levels(8, 40, 0.5, 1.0)(rng, samples)
    return np.hstack([flow, levels(5, 25, 0.6, 1.0)(rng, samples)])


UNFAMILIAR: dict[str, Kind] = {
    kind.name: kind
    for kind in (
        Kind(
            "backlash",
            "A servo with a commanded position turns a damped load through a gear with play; "
            "the position of the load is measured.",
            0.05,
            1,
            levels(10, 40, 1.0),
            _backlash,
        ),
        Kind(
            "heat_exchanger",
            "A flow (u1) takes up heat (u2) in a vessel and runs through a pipe; the temperature "
            "at its end is measured. The transport takes longer the smaller the flow.",
            1.0,
            1,
            _flow_and_heat,
            _heat_exchanger,
        ),
        Kind(
            "pendulum",
            "A damped pendulum under a torque that may take it over the top; the sine and the "
            "cosine of its angle are measured.",
            0.1,
            2,
            levels(5, 30, 2.2),
            _pendulum,
        ),
        Kind(
            "stick_slip",
            "A drive of given speed pulls a mass over dry ground by a spring; the force in the "
            "spring is measured.",
            0.05,
            1,
            levels(10, 40, 0.9),
            _stick_slip,
        ),
        Kind(
            "neutralisation",
            "A base flow neutralises a strong and a weak acid in a stirred vessel; the pH is "
            "measured.",
            1.0,
            1,
            levels(3, 20, 0.18, 0.42),
            _neutralisation,
        ),
    )
}
