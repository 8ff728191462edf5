"""Gaussian priors on expressions in the parameters of the equations."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from asia.data import Array
from asia.errors import UserError
from asia.models._equations.ode import Equations
from asia.problem.physics.expressions import parse_expression


@dataclass(frozen=True)
class ParameterPriors:
    """Gaussian priors of expressions in the parameters."""

    system: Equations | None = None
    """Expressions in the parameters, as outputs; None where there are no priors."""
    mean: tuple[float, ...] = ()
    """Mean of each expression."""
    deviation: tuple[float, ...] = ()
    """Standard deviation of each expression."""

    def __len__(self) -> int:
        return len(self.mean)

    def deviations(self, parameters: Array) -> Array:
        """Distances (n, R) of the expressions from their means, in standard deviations.

        Args:
            parameters: (np, R).
        """
        nothing = np.zeros((0, *parameters.shape[1:]))
        if self.system is None:
            return nothing
        values = self.system.observe(parameters, nothing, nothing)
        return (values - np.array(self.mean)[:, None]) / np.array(self.deviation)[:, None]


NO_PRIORS = ParameterPriors()


def parameter_priors(
    system: Equations, priors: Iterable[tuple[str, float, float]], width: float
) -> ParameterPriors:
    """Parse priors on expressions in the parameters.

    Args:
        system: equations with the parameters.
        priors: expression, mean and standard deviation each.
        width: factor on the standard deviations.

    Raises:
        UserError: for an expression that does not parse or that names something else than
            parameters and constants.
    """
    rows = list(priors)
    if not rows:
        return NO_PRIORS
    parsed = [parse_expression(text, "prior") for text, _, _ in rows]
    known = {*system.parameters, *(name for name, _ in system.constants)}
    for expression in parsed:
        for name in sorted(expression.names - known):
            raise UserError(
                f"prior '{expression.text}': '{name}' is no parameter, known are "
                f"{', '.join(sorted(known))}"
            )
    bare = replace(
        system,
        states=(),
        inputs=(),
        outputs=tuple(text for text, _, _ in rows),
        definitions=(),
        dynamics=(),
        observation=tuple(parsed),
    )
    return ParameterPriors(
        bare, tuple(mean for _, mean, _ in rows), tuple(width * s for _, _, s in rows)
    )
