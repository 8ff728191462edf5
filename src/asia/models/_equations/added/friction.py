"""Dry friction, hysteresis and play as terms and states of the equations.

Forces are per unit of inertia: they are subtracted from the derivative of a velocity. All widths
are
kept above what the integrator's step can follow. Sources: Armstrong-Helouvry, Dupont and Canudas de
Wit, Automatica 30(7), 1994 (Stribeck); Canudas de Wit, Olsson, Astrom and Lischinsky, IEEE Trans.
Automatic Control 40(3), 1995 (LuGre); Wen, J. Engineering Mechanics 102(2), 1976 (Bouc-Wen).
"""

from __future__ import annotations

from dataclasses import dataclass

from asia.models._equations.added.numbers import Extension, formula
from asia.problem.physics.expressions import Name, Node, Number

# Prior deviations: of levels, in the usual rate of the velocity; of the excess of sticking over
# sliding friction; of a bristle's damping.
_LEVEL_DEVIATION, _STRIBECK_DEVIATION, _DAMPING_DEVIATION = 2.0, 0.5, 1.0
# Velocities relative to the velocity's span, and displacements relative to the square of that span
# divided by its rate.
_STRIBECK_VELOCITY, _WIDTH, _BREAKAWAY, _YIELD = 0.1, 0.01, 0.01, 0.1
_SIZE_DEVIATION = 1.2
# Half width of a play relative to the span of its signal, and the deviation of its logarithm.
_PLAY, _PLAY_DEVIATION = 0.02, 2.0
BOUND = 3.0
"""Bound of states that are relative to a level."""


@dataclass(frozen=True)
class Force:
    """Force that is subtracted from the derivative of a velocity."""

    node: Node
    """Force per unit of inertia."""
    states: tuple[tuple[str, Node], ...] = ()
    """States of the force, each with its derivative."""


def stribeck(extension: Extension, velocity: str, step: float) -> Force:
    """Smooth Coulomb friction with Stribeck effect and viscous friction, each with separate levels
    in the two directions.

    Args:
        extension: collects the numbers.
        velocity: name of the velocity.
        step: step of the integrator in s.
    """
    level, uneven, extra, bend = _levels(extension, velocity)
    width = _size(extension, f"{velocity} friction width", _WIDTH)
    viscous = extension.number(f"{velocity} viscous friction", 0.0, _LEVEL_DEVIATION)
    uneven_viscous = extension.number(f"{velocity} viscous asymmetry", 0.0, _LEVEL_DEVIATION)
    span, rate = extension.span(velocity)[1], extension.rate(velocity)
    narrow = formula(
        "max(width * span, 0.5 * h * rate * (abs(level) + abs(uneven)) * (1 + abs(extra)))",
        width=width, span=span, h=Number(step), rate=rate, level=level, uneven=uneven, extra=extra,
    )  # fmt: skip
    sign = formula("tanh(v / narrow)", v=Name(velocity), narrow=narrow)
    node = formula(
        "rate * ((level + uneven * s) * s * bend + (c + d * s) * v / span)",
        rate=rate, level=level, uneven=uneven, s=sign, bend=bend, c=viscous, d=uneven_viscous,
        v=Name(velocity), span=span,
    )  # fmt: skip
    return Force(node)


def lugre(extension: Extension, velocity: str, step: float) -> Force:
    """LuGre friction: a bristle that deflects before it slides, relative to its deflection in
    sliding."""
    level, uneven, extra, bend = _levels(extension, velocity)
    del extra
    z, v = Name(f"{velocity} bristle"), Name(velocity)
    rate = extension.rate(velocity)
    size = _size(extension, f"{velocity} breakaway", _BREAKAWAY)
    breakaway = _displacement(extension, velocity, size, level, step)
    slip = formula("v - abs(v) * z / max(bend, 0.5)", v=v, z=z, bend=bend)
    damping = extension.number(f"{velocity} bristle damping", 0.0, _DAMPING_DEVIATION)
    node = formula(
        "rate * (level + uneven * z) * (z + damping * slip / span)",
        rate=rate, level=level, uneven=uneven, z=z, slip=slip, damping=damping,
        span=extension.span(velocity)[1],
    )  # fmt: skip
    return Force(node, ((z.name, formula("slip / reach", slip=slip, reach=breakaway)),))


def bouc_wen(extension: Extension, velocity: str, step: float) -> Force:
    """Bouc-Wen hysteresis: a restoring force that yields, with a memory of its reversals."""
    level = extension.number(f"{velocity} hysteresis", 0.0, _LEVEL_DEVIATION)
    power = extension.number(f"{velocity} sharpness", 1.0, 0.5, positive=True)
    share = extension.number(f"{velocity} loop shape", 0.5, 0.3)
    z, v = Name(f"{velocity} hysteretic"), Name(velocity)
    size = _size(extension, f"{velocity} yield", _YIELD)
    reach = _displacement(extension, velocity, size, level, step)
    size = formula("(abs(z) + 0.000001) ** n", z=z, n=power)
    derivative = formula(
        "(v - size * (b * abs(v) * z / (abs(z) + 0.000001) + (1 - b) * v)) / reach",
        v=v, z=z, size=size, b=share, reach=reach,
    )  # fmt: skip
    force = formula("rate * level * z", rate=extension.rate(velocity), level=level, z=z)
    return Force(force, ((z.name, derivative),))


def play(extension: Extension, name: str, span: Node, time: float) -> tuple[str, Node]:
    """State that follows a signal behind a play, and its derivative.

    Args:
        extension: collects the numbers.
        name: name of the signal.
        span: range of the signal.
        time: time constant of the following in s.
    """
    half = extension.number(f"{name} play", _PLAY, _PLAY_DEVIATION, positive=True)
    state = f"{name} behind play"
    derivative = formula(
        "(max(x - p - r * span, 0) + min(x - p + r * span, 0)) / time",
        x=Name(name), p=Name(state), r=half, span=span, time=Number(time),
    )  # fmt: skip
    return state, derivative


def _levels(extension: Extension, velocity: str) -> tuple[Node, Node, Node, Node]:
    """Coulomb level, its asymmetry, the Stribeck effect, and its factor at the velocity."""
    level = extension.number(f"{velocity} dry friction", 0.0, _LEVEL_DEVIATION)
    uneven = extension.number(f"{velocity} dry asymmetry", 0.0, 0.5 * _LEVEL_DEVIATION)
    extra = extension.number(f"{velocity} Stribeck effect", 0.0, _STRIBECK_DEVIATION)
    size = _size(extension, f"{velocity} Stribeck velocity", _STRIBECK_VELOCITY)
    span = extension.span(velocity)[1]
    bend = formula(
        "1 + extra * exp(-(v / (size * span)) ** 2)",
        extra=extra, v=Name(velocity), size=size, span=span,
    )  # fmt: skip
    return level, uneven, extra, bend


def _size(extension: Extension, name: str, mean: float) -> Node:
    return extension.number(name, mean, _SIZE_DEVIATION, positive=True)


def _displacement(
    extension: Extension, velocity: str, size: Node, level: Node, step: float
) -> Node:
    """Displacement that the integrator can follow."""
    return formula(
        "max(size * span * span / rate, h * h * rate * abs(level), h * abs(v))",
        size=size, span=extension.span(velocity)[1], rate=extension.rate(velocity),
        level=level, h=Number(step), v=Name(velocity),
    )  # fmt: skip
