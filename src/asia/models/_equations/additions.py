"""Additions to the equations as numbers and priors."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from asia.data.trajectory import Array
from asia.errors import UserError
from asia.models._arrays import AnyArray, namespace
from asia.models._equations.ode import Equations
from asia.problem.physics import Binary, Call, Name, Negative, Node, Number, parse_expression

# Additions that are written into the equations: lags, smooth corrections, bent sensors.
#
# Each changes the parsed expressions and brings learned numbers, so that simulation needs no
# knowledge of them.

KNOTS = 6
# Length scale of a kernel, in spans of the signal: a correction bends about once over the span.
LENGTH = 0.4


@dataclass(frozen=True)
class LearnedNumbers:
    """Numbers that additions bring: parameters of the extended equations, after those of the
    problem file."""

    names: tuple[str, ...] = ()  # Names, one a number
    mean: tuple[float, ...] = ()  # Prior means, of the logarithm where the number is positive
    factor: tuple[tuple[float, ...], ...] = ()
    """Square root (n, n) of the prior covariance: coordinates are standard normal."""
    positive: tuple[bool, ...] = ()  # The logarithm is searched, one flag a number
    spans: tuple[str, ...] = ()
    """States whose lowest and highest value are appended, for expressions that need them."""
    rates: tuple[str, ...] = ()  # States whose usual rate of change is appended after these

    def values(self, z: AnyArray) -> list[AnyArray]:
        """Numbers from their coordinates z (n, ...)."""
        xp = namespace(z)
        if not self.names:
            return []
        raw = np.array(self.mean)[:, None] + np.array(self.factor) @ z
        return [xp.exp(v) if p else v for v, p in zip(raw, self.positive, strict=True)]


NO_NUMBERS = LearnedNumbers()


class Extension:
    """Collector of additions to a system of equations."""

    def __init__(self) -> None:
        self._names: list[str] = []
        self._mean: list[float] = []
        self._positive: list[bool] = []
        self._blocks: list[np.ndarray] = []
        self._spans: list[str] = []
        self._rates: list[str] = []

    def number(self, name: str, mean: float, deviation: float, positive: bool = False) -> Node:
        """Add a number."""
        self._add([name], [np.log(mean) if positive else mean], np.array([[deviation]]), positive)
        return Name(name)

    def process(self, name: str, deviation: float) -> list[Node]:
        """Weights of the kernels of a Gaussian process with zero mean."""
        names = [f"{name} {k}" for k in range(KNOTS)]
        self._add(names, [0.0] * KNOTS, deviation * _kernel_root(), False)
        return [Name(n) for n in names]

    def span(self, state: str) -> tuple[Node, Node]:
        """Lowest value of a state, and its range."""
        if state not in self._spans:
            self._spans.append(state)
        low, high = Name(f"{state} low"), Name(f"{state} high")
        return low, Binary("-", high, low)

    def rate(self, state: str) -> Node:
        """Usual rate of change of a state: the root of its mean square."""
        if state not in self._rates:
            self._rates.append(state)
        return Name(f"{state} rate")

    def _add(self, names: list[str], mean: list[float], block: np.ndarray, positive: bool) -> None:
        self._names += names
        self._mean += mean
        self._positive += [positive] * len(names)
        self._blocks.append(block)

    def finished(self) -> LearnedNumbers:
        """All numbers."""
        size = len(self._names)
        factor, first = np.zeros((size, size)), 0
        for block in self._blocks:
            there = slice(first, first + len(block))
            factor[there, there] = block
            first += len(block)
        return LearnedNumbers(
            tuple(self._names),
            tuple(self._mean),
            tuple(tuple(float(v) for v in row) for row in factor),
            tuple(self._positive),
            tuple(self._spans),
            tuple(self._rates),
        )


@cache
def _kernel_root() -> np.ndarray:
    """Matrix from standard normal coordinates to weights of the kernels at the knots."""
    x = np.linspace(0.0, 1.0, KNOTS)
    gram = np.exp(-0.5 * ((x[:, None] - x) / LENGTH) ** 2) + 1e-4 * np.eye(KNOTS)
    return np.linalg.inv(np.linalg.cholesky(gram)).T


def formula(text: str, **nodes: Node) -> Node:
    """Parse text to a tree and replace its names."""
    return substituted(parse_expression(text, "addition").root, nodes)


def substituted(node: Node, nodes: Mapping[str, Node]) -> Node:
    """Replace some names of a tree by trees."""
    match node:
        case Name(name):
            return nodes.get(name, node)
        case Negative(operand):
            return Negative(substituted(operand, nodes))
        case Binary(symbol, left, right):
            return Binary(symbol, substituted(left, nodes), substituted(right, nodes))
        case Call(function, arguments):
            return Call(function, tuple(substituted(a, nodes) for a in arguments))
        case Number():
            return node


def total(terms: Sequence[Node]) -> Node:
    """Sum of trees."""
    found = terms[0]
    for term in terms[1:]:
        found = Binary("+", found, term)
    return found


# Gaussian priors on expressions in the parameters of the equations.


@dataclass(frozen=True)
class ParameterPriors:
    """Gaussian priors of expressions in the parameters."""

    system: Equations | None = None
    """Expressions in the parameters, as outputs; None where there are no priors."""
    mean: tuple[float, ...] = ()  # Mean of each expression
    deviation: tuple[float, ...] = ()  # Standard deviation of each expression

    def __len__(self) -> int:
        return len(self.mean)

    def deviations(self, parameters: Array) -> Array:
        """Distances (n, R) of the expressions from their means, in standard deviations, at
        parameters (np, R)."""
        nothing = np.zeros((0, *parameters.shape[1:]))
        if self.system is None:
            return nothing
        values = self.system.observe(parameters, nothing, nothing)
        return (values - np.array(self.mean)[:, None]) / np.array(self.deviation)[:, None]


NO_PRIORS = ParameterPriors()


def parameter_priors(
    system: Equations, priors: Iterable[tuple[str, float, float]], width: float
) -> ParameterPriors:
    """Parse priors on expressions in the parameters of the equations: expression, mean and standard
    deviation each; `width` is a factor on the deviations.

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
