"""Equations with additions written in: friction, terms."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations_with_replacement

import numpy as np

from asia.data.trajectory import Array
from asia.models._equations.additions import KNOTS, LENGTH, Extension, formula, substituted, total
from asia.models._equations.config import GreyBoxStructure
from asia.models._equations.ode import Equations, functions, of_node
from asia.models._equations.starts import RecordSegments
from asia.problem.physics import (
    Binary,
    Expression,
    Name,
    Node,
    Number,
    names_in,
    parse_expression,
)

# Dry friction, hysteresis and play as terms and states of the equations.
#
# Forces are per unit of inertia: they are subtracted from the derivative of a velocity. All widths
# are kept above what the integrator's step can follow. Sources: Armstrong-Helouvry, Dupont and
# Canudas de Wit, Automatica 30(7), 1994 (Stribeck); Canudas de Wit, Olsson, Astrom and Lischinsky,
# IEEE Trans. Automatic Control 40(3), 1995 (LuGre); Wen, J. Engineering Mechanics 102(2), 1976
# (Bouc-Wen).

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

    node: Node  # Force per unit of inertia
    states: tuple[tuple[str, Node], ...] = ()  # States of the force, each with its derivative


def stribeck(extension: Extension, velocity: str, step: float) -> Force:
    """Smooth Coulomb friction with Stribeck effect and viscous friction, each with separate levels
    in the two directions; `step` is that of the integrator in s."""
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
    """State that follows a signal behind a play, and its derivative, from the range of the signal
    and the time constant of the following in s."""
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


# Equations from the problem file, extended by the additions of a config.

# Prior deviations of a sensor: of its zero in spans, of the logarithms of its power and of its
# slopes.
_ZERO_DEVIATION, _POWER_DEVIATION, _SLOPE_DEVIATION = 0.1, 0.5, 0.5
# Prior deviation of the logarithm of a time constant, about one sample.
_LAG_DEVIATION = 0.7
# Shift in spans that keeps the slope of a power finite at zero.
_POWER_SHIFT = 0.02


def extended(structure: GreyBoxStructure, segments: RecordSegments) -> GreyBoxStructure:
    """Write all additions that change expressions into a structure; return it unchanged without
    any."""
    if not structure.config.extends or structure.learned.names:
        return structure
    return _Builder(structure, segments).built()


class _Builder:
    def __init__(self, structure: GreyBoxStructure, segments: RecordSegments) -> None:
        inside = segments.mask > 0
        self._structure, self._config = structure, structure.config
        self._system, self._extension = structure.equations, Extension()
        self._input_ranges = [_range(v) for v in segments.u[inside].T]
        self._output_ranges = [_range(v) for v in segments.y[inside].T]

    def built(self) -> GreyBoxStructure:
        structure, config, system = self._structure, self._config, self._system
        signals = (*system.states, *system.inputs)
        late = {name: Name(f"{name} lagged") for name in signals if name in config.lag}
        # Fastest time constant that Runge-Kutta steps follow without oscillation.
        step = structure.sampling_time / config.substeps
        time = structure.sampling_time / (1.5 * config.substeps)
        behind = {
            name: play(self._extension, name, self._span(name)[1], time)
            for name in signals
            if name in config.play
        }
        # Signals in the form that the equations read.
        read: dict[str, Node] = {name: Name(name) for name in signals}
        for name in signals:
            if name in config.smooth:
                low, span = self._span(name)
                weights = self._extension.process(f"{name} bend", config.smooth_width)
                place = formula("(x - low) / span", x=Name(name), low=low, span=span)
                bend = _process(weights, place)
                read[name] = formula("x * exp(bend)", x=Name(name), bend=bend)
        instead = late | {name: Name(state) for name, (state, _) in behind.items()}
        others = {
            n: substituted(read[n], {n: instead[n]}) if n in instead else read[n] for n in signals
        }
        dry = lugre if config.presliding else stribeck
        forces = [(name, dry(self._extension, name, step)) for name in config.friction]
        forces += [(name, bouc_wen(self._extension, name, step)) for name in config.hysteresis]
        dynamics = [
            substituted(_inlined(system, e), {**others, state: read[state]})
            for state, e in zip(system.states, system.dynamics, strict=True)
        ]
        for velocity, force in forces:
            place = system.states.index(velocity)
            dynamics[place] = Binary("-", dynamics[place], force.node)
        dynamics += [self._lag(name) for name in late]
        # States of additions, each with its derivative, after those of the lags.
        new = [*behind.values(), *(pair for _, force in forces for pair in force.states)]
        dynamics += [derivative for _, derivative in new]
        observation = [_inlined(system, e) for e in system.observation]
        if config.sensor is not None:
            observation = [self._sensor(k, node) for k, node in enumerate(observation)]
        learned = self._extension.finished()
        spans = [f"{name} {end}" for name in learned.spans for end in ("low", "high")]
        rates = [f"{name} rate" for name in learned.rates]
        free = len(late) + len(behind)
        # An output that shows a state also shows its lag or the play behind it.
        shown = dict(structure.measured_states)
        for k, name in enumerate([*late, *behind]):
            if name in system.states and system.states.index(name) in shown:
                shown[len(system.states) + k] = shown[system.states.index(name)]
        bound = (BOUND,) * (len(new) - len(behind))
        return replace(
            structure,
            equations=replace(
                system,
                states=(
                    *system.states,
                    *(node.name for node in late.values()),
                    *(name for name, _ in new),
                ),
                parameters=(*system.parameters, *learned.names, *spans, *rates),
                definitions=(),
                dynamics=tuple(of_node(node) for node in dynamics),
                observation=tuple(of_node(node) for node in observation),
                rest=tuple(of_node(_inlined(system, e)) for e in system.rest),
                delays=tuple(
                    replace(
                        one,
                        value=_inlined(system, of_node(one.value)),
                        flow=_inlined(system, of_node(one.flow)),
                        volume=_inlined(system, of_node(one.volume)),
                        dispersion=_inlined(system, of_node(one.dispersion)),
                    )
                    for one in system.delays
                ),
            ),
            low=(*structure.low, *(-math.inf,) * free, *(-b for b in bound)),
            high=(*structure.high, *(math.inf,) * free, *bound),
            learned=learned,
            problem_states=structure.nx_own,
            shown=tuple(shown.items()),
        )

    def _span(self, name: str) -> tuple[Node, Node]:
        """Lowest value of a signal, and its range."""
        if name not in self._system.inputs:
            return self._extension.span(name)
        low, high = self._input_ranges[self._system.inputs.index(name)]
        return Number(low), Number(high - low)

    def _lag(self, name: str) -> Node:
        step = self._structure.sampling_time
        time = self._extension.number(f"{name} lag", step, _LAG_DEVIATION, positive=True)
        # A shorter lag would make an explicit step unstable.
        least = Number(0.5 * step / self._config.substeps)
        return formula(
            "(x - late) / max(time, least)",
            x=Name(name), late=Name(f"{name} lagged"), time=time, least=least,
        )  # fmt: skip

    def _sensor(self, output: int, node: Node) -> Node:
        """Output as a rising curve of its expression."""
        name = self._system.outputs[output]
        low, high = self._output_ranges[output]
        if isinstance(node, Name) and node.name in self._system.states:
            state = self._system.states.index(node.name)
            bottom, top = self._structure.low[state], self._structure.high[state]
            low = bottom if math.isfinite(bottom) else low
            high = top if math.isfinite(top) else high
        high = high if high > low else low + 1.0
        place = formula(
            "max((x - low) / span, 0)", x=node, low=Number(low), span=Number(high - low)
        )
        zero = self._extension.number(f"{name} zero", 0.0, _ZERO_DEVIATION)
        if self._config.sensor == "power":
            power = self._extension.number(f"{name} power", 1.0, _POWER_DEVIATION, positive=True)
            rise = formula(
                "((x + s) ** p - s ** p) / ((1 + s) ** p - s ** p)",
                x=place, p=power, s=Number(_POWER_SHIFT),
            )  # fmt: skip
        else:
            rise = _rising(self._extension.process(f"{name} slope", _SLOPE_DEVIATION), place)
        return formula(
            "low + span * (zero + (1 - zero) * rise)",
            low=Number(low), span=Number(high - low), zero=zero, rise=rise,
        )  # fmt: skip


def _range(values: Array) -> tuple[float, float]:
    """Lowest and highest value, never equal."""
    low, high = float(values.min()), float(values.max())
    return low, high if high > low else low + 1.0


def _inlined(system: Equations, e: Expression) -> Node:
    """Expression with the definitions put in."""
    known: dict[str, Node] = {}
    for name, definition in system.definitions:
        known[name] = substituted(definition.root, known)
    return substituted(e.root, known)


def _process(weights: Sequence[Node], place: Node) -> Node:
    """Weighted sum of squared exponential kernels."""
    terms = [
        formula(
            "w * exp(-0.5 * ((x - knot) / length) ** 2)",
            w=w, x=place, knot=Number(k / (KNOTS - 1)), length=Number(LENGTH),
        )
        for k, w in enumerate(weights)
    ]  # fmt: skip
    return total(terms)


def _rising(weights: Sequence[Node], place: Node) -> Node:
    """Curve through (0, 0) and (1, 1) whose slope is positive: linear between knots, the
    exponential of a Gaussian process at them."""
    slopes = [formula("exp(g)", g=_process(weights, Number(k / (KNOTS - 1)))) for k in range(KNOTS)]
    parts: list[Node] = []
    areas: list[Node] = []
    for k in range(KNOTS - 1):
        last = k == KNOTS - 2
        inside = formula(
            "max(x * n - k, 0)" if last else "clip(x * n - k, 0, 1)",
            x=place, n=Number(KNOTS - 1), k=Number(float(k)),
        )  # fmt: skip
        bent = formula("clip(t, 0, 1)", t=inside)
        parts.append(
            formula(
                "a * t + 0.5 * (b - a) * (s * s + 2 * (t - s))",
                a=slopes[k], b=slopes[k + 1], t=inside, s=bent,
            )
        )  # fmt: skip
        areas.append(formula("0.5 * (a + b)", a=slopes[k], b=slopes[k + 1]))
    return Binary("/", total(parts), total(areas))


# Candidate terms of the equations: products of signals, each with a number of its own.

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

    state: str  # State whose derivative gets the term
    text: str  # Expression in states and inputs
    deviation: float  # Prior standard deviation of the number, whose prior mean is 0

    @property
    def name(self) -> str:
        """Name of the number."""
        return f"{self.state}: {self.text}"


def library(structure: GreyBoxStructure, x: Array, u: Array, rates: Array) -> list[Term]:
    """Terms for the states in `Config.discover`: a constant, signals, products of two, signals
    times their size and cubes, without those that are proportional to another; from simulated
    states x (N, nx), inputs u (N, nu) and root mean squares `rates` (nx,) of the derivatives of the
    states."""
    system, own = structure.equations, structure.nx_own
    names = (*system.states[:own], *system.inputs)
    values = dict(zip(names, np.concatenate([x[:, :own], u], axis=1).T, strict=True))
    # Texts of the expressions, the simplest first.
    count = len(structure.config.discover)
    pairs = combinations_with_replacement(names, 2)
    products = [f"{a}**2" if a == b else f"{a} * {b}" for a, b in pairs]
    texts = ["1", *names, *products, *(f"{a} * abs({a})" for a in names)]
    if count * (len(texts) + len(names)) <= _MOST_TERMS:
        texts += [f"{a}**3" for a in names]
    # Root mean squares of the expressions that are no multiple of a simpler one.
    table, ones, directions = functions(np), np.ones(len(x)), list[Array]()
    kept: dict[str, float] = {}
    for text in texts[: max(1, _MOST_TERMS // count)]:
        value = ones * parse_expression(text, "term").evaluate(values, table)
        size = float(np.sqrt((value**2).mean()))
        if not 0.0 < size < np.inf:
            continue
        direction = value / (size * np.sqrt(len(value)))
        if all(abs(float(direction @ other)) < _ALIKE for other in directions):
            directions.append(direction)
            kept[text] = size
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
    dynamics = list(system.dynamics)
    for i, (state, e) in enumerate(zip(system.states, system.dynamics, strict=True)):
        own = [term for term in terms if term.state == state]
        if own:
            products = [Binary("*", Name(t.name), formula(t.text)) for t in own]
            named = frozenset(t.name for t in own).union(*(names_in(p) for p in products))
            dynamics[i] = Expression("", total([e.root, *products]), e.names | named)
    return replace(
        structure,
        equations=replace(
            system,
            parameters=(*system.parameters[:place], *names, *system.parameters[place:]),
            dynamics=tuple(dynamics),
        ),
        learned=replace(
            learned,
            names=(*learned.names, *names),
            mean=(*learned.mean, *(0.0 for _ in terms)),
            factor=tuple(tuple(float(v) for v in row) for row in factor),
            positive=(*learned.positive, *(False for _ in terms)),
        ),
    )
