"""The person's equations as functions of JAX arrays."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from types import MappingProxyType

import jax
import jax.numpy as jnp

from asia.problem import Physics
from asia.problem.physics.check import check_physics, definition_order
from asia.problem.physics.expressions import Expression, Name, parse_expression

Derivative = Callable[[jax.Array, jax.Array], jax.Array]


def safe_sqrt(x: jax.Array) -> jax.Array:
    """Square root with a finite derivative at 0; 0 below.

    Under 1e-6 it goes on as the straight line through 0, so that an empty tank can fill again.
    """
    small = 1e-6
    inside = jnp.maximum(x, small)
    return jnp.where(x > small, jnp.sqrt(inside), jnp.maximum(x, 0.0) / small**0.5)


def _safe_log(x: jax.Array) -> jax.Array:
    return jnp.log(jnp.maximum(x, 1e-12))


def _clip(x: jax.Array, low: jax.Array, high: jax.Array) -> jax.Array:
    return jnp.minimum(jnp.maximum(x, low), high)


JAX_FUNCTIONS: Mapping[str, Callable[..., jax.Array]] = MappingProxyType(
    {
        "sqrt": safe_sqrt,
        "exp": jnp.exp,
        "log": _safe_log,
        "sin": jnp.sin,
        "cos": jnp.cos,
        "tan": jnp.tan,
        "arcsin": jnp.arcsin,
        "arccos": jnp.arccos,
        "arctan": jnp.arctan,
        "arctan2": jnp.arctan2,
        "sinh": jnp.sinh,
        "cosh": jnp.cosh,
        "tanh": jnp.tanh,
        "sigmoid": jax.nn.sigmoid,
        "softplus": jax.nn.softplus,
        "abs": jnp.abs,
        "sign": jnp.sign,
        "min": lambda *x: reduce(jnp.minimum, x),
        "max": lambda *x: reduce(jnp.maximum, x),
        "clip": _clip,
    }
)
"""The function table of the expressions, for JAX."""


@dataclass(frozen=True)
class Equations:
    """Parsed physics: hashable, so that a compiled simulator can be found by it."""

    states: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    parameters: tuple[str, ...]
    constants: tuple[tuple[str, float], ...]
    definitions: tuple[tuple[str, Expression], ...]
    dynamics: tuple[Expression, ...]
    observation: tuple[Expression, ...]

    def derivative(self, parameters: jax.Array, x: jax.Array, u: jax.Array) -> jax.Array:
        """d/dt of the states: parameters (np,), x (nx,), u (nu,) -> (nx,)."""
        return self._evaluate(self.dynamics, parameters, x, u)

    def observe(self, parameters: jax.Array, x: jax.Array, u: jax.Array) -> jax.Array:
        """Outputs: parameters (np,), x (nx,), u (nu,) -> (ny,)."""
        return self._evaluate(self.observation, parameters, x, u)

    def named(
        self, names: tuple[str, ...], parameters: jax.Array, x: jax.Array, u: jax.Array
    ) -> jax.Array:
        """Values (len(names),) of states, inputs, parameters or definitions."""
        expressions = tuple(Expression(n, Name(n), frozenset((n,))) for n in names)
        return self._evaluate(expressions, parameters, x, u) if names else jnp.zeros(0, x.dtype)

    def closure(self, expression: Expression) -> frozenset[str]:
        """All names an expression depends on, definitions followed."""
        known = dict(self.definitions)
        found, left = set[str](), set(expression.names)
        while left:
            name = left.pop()
            found.add(name)
            if name in known:
                left |= known[name].names - found
        return frozenset(found)

    def _evaluate(
        self, expressions: tuple[Expression, ...], parameters: jax.Array, x: jax.Array, u: jax.Array
    ) -> jax.Array:
        values: dict[str, jax.Array] = {name: jnp.asarray(v) for name, v in self.constants}
        values |= {name: u[i] for i, name in enumerate(self.inputs)}
        values |= {name: x[i] for i, name in enumerate(self.states)}
        values |= {name: parameters[i] for i, name in enumerate(self.parameters)}
        for name, expression in self.definitions:
            values[name] = expression.evaluate(values, JAX_FUNCTIONS)
        results = [expression.evaluate(values, JAX_FUNCTIONS) for expression in expressions]
        return jnp.stack([jnp.asarray(result, dtype=x.dtype) for result in results])


def equations(physics: Physics, inputs: Sequence[str], outputs: Sequence[str]) -> Equations:
    """Parse and check `physics` for these signals. Raises UserError where they do not fit."""
    check_physics(physics, inputs, outputs)

    def parsed(section: str, name: str, text: str) -> Expression:
        return parse_expression(text, f"[physics.{section}] {name}")

    return Equations(
        states=physics.states,
        inputs=tuple(inputs),
        outputs=tuple(outputs),
        parameters=tuple(physics.parameters),
        constants=tuple(physics.constants.items()),
        definitions=tuple(
            (name, parsed("definitions", name, physics.definitions[name]))
            for name in definition_order(physics)
        ),
        dynamics=tuple(parsed("dynamics", s, physics.dynamics[s]) for s in physics.states),
        observation=tuple(parsed("observation", o, physics.observation.get(o, o)) for o in outputs),
    )


def runge_kutta(derivative: Derivative, x: jax.Array, u: jax.Array, step: float) -> jax.Array:
    """One classical fourth-order Runge-Kutta step with u held."""
    k1 = derivative(x, u)
    k2 = derivative(x + 0.5 * step * k1, u)
    k3 = derivative(x + 0.5 * step * k2, u)
    k4 = derivative(x + step * k3, u)
    return x + step / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
