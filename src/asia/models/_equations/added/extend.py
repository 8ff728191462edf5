"""Equations from the problem file, extended by the additions of a config."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from asia.data import Array
from asia.models._equations.added.friction import (
    BOUND,
    Force,
    bouc_wen,
    lugre,
    play,
    stribeck,
)
from asia.models._equations.added.numbers import (
    KNOTS,
    LENGTH,
    Extension,
    formula,
    names_in,
    substituted,
    total,
)
from asia.models._equations.config import GreyBoxStructure
from asia.models._equations.ode import Equations
from asia.models._equations.starts import RecordPieces
from asia.problem.physics.expressions import Binary, Expression, Name, Node, Number

Range = tuple[float, float]

# Prior deviations of a sensor: of its zero in spans, of the logarithms of its power and of its
# slopes.
_ZERO_DEVIATION, _POWER_DEVIATION, _SLOPE_DEVIATION = 0.1, 0.5, 0.5
# Prior deviation of the logarithm of a time constant, about one sample.
_LAG_DEVIATION = 0.7
# Shift in spans that keeps the slope of a power finite at zero.
_POWER_SHIFT = 0.02


def extended(structure: GreyBoxStructure, segments: RecordPieces) -> GreyBoxStructure:
    """Write all additions that change expressions into a structure; return it unchanged without
    any."""
    if not structure.config.extends or structure.learned.names:
        return structure
    return _Builder(structure, segments).built()


class _Builder:
    def __init__(self, structure: GreyBoxStructure, segments: RecordPieces) -> None:
        inside = segments.mask > 0
        self._structure, self._config = structure, structure.config
        self._system, self._extension = structure.equations, Extension()
        self._input_ranges = [_range(v) for v in segments.u[inside].T]
        self._output_ranges = [_range(v) for v in segments.y[inside].T]

    def built(self) -> GreyBoxStructure:
        structure, config, system = self._structure, self._config, self._system
        signals = (*system.states, *system.inputs)
        late = {name: Name(f"{name} lagged") for name in signals if name in config.lag}
        behind = {name: self._play(name) for name in signals if name in config.play}
        read = {name: self._as_read(name) for name in signals}
        instead = late | {name: Name(state) for name, (state, _) in behind.items()}
        others = {
            n: substituted(read[n], {n: instead[n]}) if n in instead else read[n] for n in signals
        }
        forces = self._forces()
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
                dynamics=tuple(_expression(node) for node in dynamics),
                observation=tuple(_expression(node) for node in observation),
            ),
            low=(*structure.low, *(-math.inf,) * free, *(-b for b in bound)),
            high=(*structure.high, *(math.inf,) * free, *bound),
            learned=learned,
            person_states=len(system.states),
            shown=self._shown([*late, *behind]),
        )

    def _forces(self) -> list[tuple[str, Force]]:
        """Forces on velocities."""
        config, step = self._config, self._structure.sampling_time / self._config.substeps
        dry = lugre if config.presliding else stribeck
        found = [(name, dry(self._extension, name, step)) for name in config.friction]
        return found + [(name, bouc_wen(self._extension, name, step)) for name in config.hysteresis]

    def _play(self, name: str) -> tuple[str, Node]:
        # Fastest time constant that Runge-Kutta steps follow without oscillation.
        time = self._structure.sampling_time / (1.5 * self._config.substeps)
        return play(self._extension, name, self._span(name)[1], time)

    def _shown(self, lagged: list[str]) -> tuple[tuple[int, int], ...]:
        """Outputs that show states; an output that shows a state also shows its lag or the play
        behind it."""
        shown, states = dict(self._structure.measured_states), self._system.states
        for k, name in enumerate(lagged):
            if name in states and states.index(name) in shown:
                shown[len(states) + k] = shown[states.index(name)]
        return tuple(shown.items())

    def _as_read(self, name: str) -> Node:
        """Signal in the form that the equations read."""
        node = Name(name)
        if name not in self._config.smooth:
            return node
        low, span = self._span(name)
        weights = self._extension.process(f"{name} bend", self._config.smooth_width)
        place = formula("(x - low) / span", x=node, low=low, span=span)
        return formula("x * exp(bend)", x=node, bend=_process(weights, place))

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
        low, high = self._sensor_range(output, node)
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

    def _sensor_range(self, output: int, node: Node) -> Range:
        low, high = self._output_ranges[output]
        if isinstance(node, Name) and node.name in self._system.states:
            state = self._system.states.index(node.name)
            bottom, top = self._structure.low[state], self._structure.high[state]
            low = bottom if math.isfinite(bottom) else low
            high = top if math.isfinite(top) else high
        return low, high if high > low else low + 1.0


def _range(values: Array) -> Range:
    """Lowest and highest value, never equal."""
    low, high = float(values.min()), float(values.max())
    return low, high if high > low else low + 1.0


def _expression(node: Node) -> Expression:
    return Expression("", node, names_in(node))


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
