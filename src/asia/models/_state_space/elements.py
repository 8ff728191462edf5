"""Elements of dry friction and of play in a discrete state-space model, for NumPy and JAX.

An element of friction resists the motion of a learned direction of the state and is solved
implicitly, so that the state can stand still. With the next state x' that there would be without
it, q = w' x' + b and gain g, its force is F = sat((z + k q) / (1 + k w' g)), its next state is F,
and x' - g F follows. A stiff one (k large) is Coulomb friction, a soft one an elastoplastic spring;
several together make hysteresis of any shape. An element of play follows a direction of state and
input within a width; what is not followed acts on state and output. Sources: Iwan, J. Applied
Mechanics 33(4), 1966; Visintin, Differential Models of Hysteresis, Springer 1994.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from asia.models._arrays import AnyArray, bounded, namespace, relu

Coefficients = Mapping[str, Any]

# Limit on the exponents of learned ratios, which keeps them finite.
_LARGEST = 8.0


def resisted(
    p: Coefficients, now: AnyArray, z: AnyArray, free: AnyArray
) -> tuple[AnyArray, AnyArray]:
    """Solve the friction of one sample.

    Args:
        p: coefficients.
        now: states (..., n).
        z: forces (..., m).
        free: next state without friction (..., n).

    Returns:
        The next state with friction, and the forces in it.
    """
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
    """Solve the play of one sample.

    Args:
        p: coefficients.
        x: states (..., n).
        v: inputs (..., nu).
        behind: followers (..., m) before the sample.

    Returns:
        The motion that the play takes, and the followers after the sample.
    """
    signal = x @ p["w"] + v @ p["wu"]
    after = bounded(behind, signal - 1.0, signal + 1.0)
    return signal - after, after
