"""Libraries that a candidate may import beside the standard one and `asia.models`."""

from __future__ import annotations

from importlib.util import find_spec

_LIBRARIES = ("numpy", "scipy", "jax", "equinox", "optax")


def installed_libraries() -> tuple[str, ...]:
    """Names of these libraries that are installed here, as agents and users read them."""
    return tuple(name for name in _LIBRARIES if find_spec(name) is not None)
