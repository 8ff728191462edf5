"""Candidate terms of the equations: products of signals, each with a number of its own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations_with_replacement

import numpy as np

from asia.data import Array
from asia.models._equations.added.numbers import formula, names_in, total
from asia.models._equations.config import GreyBoxStructure
from asia.models._equations.ode import functions
from asia.problem.physics.expressions import Binary, Expression, Name, parse_expression

# Greatest size of a library; a larger one is built without cubes, and then without products of two
# signals.
_MOST_TERMS = 120
# Prior deviation of the numbers, in usual rates of the state over usual sizes of the product. It is
# wide, since the ridge only bounds the search and does not claim that a term is small.
_DEVIATION = 10.0
# Least cosine of the angle between two products over the records at which they count as equal.
_ALIKE = 0.9999


@dataclass(frozen=True)
class Term:
    """Number times an expression, in the derivative of a state."""

    state: str
    """State whose derivative gets the term."""
    text: str
    """Expression in states and inputs."""
    deviation: float
    """Prior standard deviation of the number, whose prior mean is 0."""

    @property
    def name(self) -> str:
        """Name of the number."""
        return f"{self.state}: {self.text}"


def library(structure: GreyBoxStructure, x: Array, u: Array, rates: Array) -> list[Term]:
    """Terms for the states in `Config.discover`: a constant, signals, products of two, signals
    times their size and cubes, without those that are proportional to another.

    Args:
        structure: grey-box.
        x: simulated states (N, nx).
        u: inputs (N, nu).
        rates: root mean squares of the derivatives of the states (nx,).
    """
    system, own = structure.equations, structure.nx_own
    names = (*system.states[:own], *system.inputs)
    values = dict(zip(names, np.concatenate([x[:, :own], u], axis=1).T, strict=True))
    texts = _texts(names, len(structure.config.discover))
    table = functions(np)
    expressions = {text: parse_expression(text, "term") for text in texts}
    ones = np.ones(len(x))
    kept = _distinct({t: ones * e.evaluate(values, table) for t, e in expressions.items()})
    return [
        Term(state, text, _DEVIATION * float(rates[system.states.index(state)]) / size)
        for state in structure.config.discover
        for text, size in kept.items()
    ]


def with_terms(structure: GreyBoxStructure, terms: Sequence[Term]) -> GreyBoxStructure:
    """Write terms into the equations of a structure; their numbers follow those that are learned
    already."""
    system, learned = structure.equations, structure.learned
    place = len(structure.ranges) + len(learned.names)
    names = tuple(term.name for term in terms)
    size = len(learned.names)
    factor = np.zeros((size + len(terms), size + len(terms)))
    if size:
        factor[:size, :size] = np.array(learned.factor)
    factor[range(size, len(factor)), range(size, len(factor))] = [t.deviation for t in terms]
    return replace(
        structure,
        equations=replace(
            system,
            parameters=(*system.parameters[:place], *names, *system.parameters[place:]),
            dynamics=tuple(
                _with_products(e, [t for t in terms if t.state == state])
                for state, e in zip(system.states, system.dynamics, strict=True)
            ),
        ),
        learned=replace(
            learned,
            names=(*learned.names, *names),
            mean=(*learned.mean, *(0.0 for _ in terms)),
            factor=tuple(tuple(float(v) for v in row) for row in factor),
            positive=(*learned.positive, *(False for _ in terms)),
        ),
    )


def _with_products(expression: Expression, terms: Sequence[Term]) -> Expression:
    if not terms:
        return expression
    products = [Binary("*", Name(t.name), formula(t.text)) for t in terms]
    names = frozenset(t.name for t in terms).union(*(names_in(p) for p in products))
    return Expression("", total([expression.root, *products]), expression.names | names)


def _texts(names: Sequence[str], states: int) -> list[str]:
    """Texts of the expressions, the simplest first."""
    pairs = combinations_with_replacement(names, 2)
    products = [f"{a}**2" if a == b else f"{a} * {b}" for a, b in pairs]
    found = ["1", *names, *products, *(f"{a} * abs({a})" for a in names)]
    cubes = [f"{a}**3" for a in names]
    if states * (len(found) + len(cubes)) <= _MOST_TERMS:
        found += cubes
    return found[: max(1, _MOST_TERMS // states)]


def _distinct(values: Mapping[str, Array]) -> dict[str, float]:
    """Root mean squares of the expressions that are no multiple of a simpler one."""
    directions: list[Array] = []
    found: dict[str, float] = {}
    for text, value in values.items():
        size = float(np.sqrt((value**2).mean()))
        if not 0.0 < size < np.inf:
            continue
        direction = value / (size * np.sqrt(len(value)))
        if all(abs(float(direction @ other)) < _ALIKE for other in directions):
            directions.append(direction)
            found[text] = size
    return found
