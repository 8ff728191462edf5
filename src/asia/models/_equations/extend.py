"""The person's equations with a config's lags, zeros, smooth corrections and sensors in them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from asia.models._equations.additions import (
    KNOTS,
    LENGTH,
    Extension,
    LearnedNumbers,
    formula,
    names_in,
    substituted,
    total,
)
from asia.models._equations.config import Config, GreyBoxStructure
from asia.models._equations.ode import Equations
from asia.models._equations.starts import RecordPieces
from asia.problem.physics.expressions import Binary, Expression, Name, Node, Number

Range = tuple[float, float]

_ZERO_DEVIATION = 0.05
_SENSOR_ZERO_DEVIATION, _POWER_DEVIATION, _SLOPE_DEVIATION = 0.1, 0.5, 0.5
_LAG_DEVIATION = 0.7
_RIM, _RIM_DEVIATION = 0.01, 0.7


def extended(structure: GreyBoxStructure, segments: RecordPieces) -> GreyBoxStructure:
    """The structure with all additions that are changes of expressions; itself without any."""
    config = structure.config
    if not config.extends or structure.learned.names:
        return structure
    inside = segments.mask > 0
    u, y = segments.u[inside], segments.y[inside]
    builder = _Builder(
        structure,
        Extension(),
        {n: (float(v.min()), float(v.max())) for n, v in zip(structure.equations.inputs, u.T)},
        [(float(v.min()), float(v.max())) for v in y.T],
    )
    return builder.built()


@dataclass
class _Builder:
    structure: GreyBoxStructure
    extension: Extension
    input_ranges: dict[str, Range]
    output_ranges: list[Range]

    def built(self) -> GreyBoxStructure:
        structure, config, system = self.structure, self.structure.config, self.structure.equations
        signals = (*system.states, *system.inputs)
        lagged = {name: Name(f"{name} lagged") for name in signals if name in config.lag}
        own = {name: self._effective(name) for name in signals}
        late = {n: substituted(own[n], {n: lagged[n]}) if n in lagged else own[n] for n in signals}
        dynamics = [
            expression(substituted(inlined(system, e), {**late, state: own[state]}))
            for state, e in zip(system.states, system.dynamics, strict=True)
        ]
        dynamics += [expression(self._lag(name)) for name in lagged]
        observation = [inlined(system, e) for e in system.observation]
        if config.sensor is not None:
            observation = [self._sensor(k, e) for k, e in enumerate(observation)]
        if config.soft:
            for name in config.saturation:
                self.extension.number(f"{name} rim", _RIM, _RIM_DEVIATION, positive=True)
        learned = self.extension.finished()
        spans = tuple(f"{name} {end}" for name in learned.spans for end in ("low", "high"))
        extended = replace(
            system,
            states=(*system.states, *(node.name for node in lagged.values())),
            parameters=(*system.parameters, *learned.names, *spans),
            definitions=(),
            dynamics=tuple(dynamics),
            observation=tuple(expression(node) for node in observation),
        )
        measured = dict(structure.measured_states)
        for k, name in enumerate(lagged):
            if name in system.states and system.states.index(name) in measured:
                measured[len(system.states) + k] = measured[system.states.index(name)]
        return replace(
            structure,
            equations=extended,
            low=(*structure.low, *(-np.inf for _ in lagged)),
            high=(*structure.high, *(np.inf for _ in lagged)),
            learned=learned,
            person_states=len(system.states),
            shown=tuple(measured.items()),
        )

    def _effective(self, name: str) -> Node:
        """A signal as the equations read it."""
        config, node = self.structure.config, Name(name)
        if name not in (*config.zero, *config.smooth):
            return node
        low, span = self._span(name)
        found: Node = node
        if name in config.zero:
            zero = self.extension.number(f"{name} zero", 0.0, _ZERO_DEVIATION)
            found = formula("x + zero * span", x=node, zero=zero, span=span)
            if self.input_ranges.get(name, (-1.0, 0.0))[0] >= 0.0:
                found = formula("max(x, 0)", x=found)
        if name in config.smooth:
            weights = self.extension.process(f"{name} bend", config.smooth_width)
            place = formula("(x - low) / span", x=node, low=low, span=span)
            found = formula("x * exp(bend)", x=found, bend=_process(weights, place))
        return found

    def _span(self, name: str) -> tuple[Node, Node]:
        if name in self.input_ranges:
            low, high = self.input_ranges[name]
            return Number(low), Number(high - low or 1.0)
        return self.extension.span(name)

    def _lag(self, name: str) -> Node:
        step = self.structure.sampling_time
        time = self.extension.number(f"{name} lag", step, _LAG_DEVIATION, positive=True)
        # Shorter ones would make an explicit step unstable.
        least = Number(0.5 * step / self.structure.config.substeps)
        return formula(
            "(x - late) / max(time, least)",
            x=Name(name), late=Name(f"{name} lagged"), time=time, least=least,
        )  # fmt: skip

    def _sensor(self, output: int, node: Node) -> Node:
        """The output as a rising curve of its expression."""
        name = self.structure.equations.outputs[output]
        low, high = self._sensor_range(output, node)
        place = formula(
            "max((x - low) / span, 0)", x=node, low=Number(low), span=Number(high - low)
        )
        zero = self.extension.number(f"{name} zero", 0.0, _SENSOR_ZERO_DEVIATION)
        if self.structure.config.sensor == "power":
            power = self.extension.number(f"{name} power", 1.0, _POWER_DEVIATION, positive=True)
            rise = formula(
                "((x + 0.02) ** p - 0.02 ** p) / (1.02 ** p - 0.02 ** p)", x=place, p=power
            )
        else:
            rise = _rising(self.extension.process(f"{name} slope", _SLOPE_DEVIATION), place)
        return formula(
            "low + span * (zero + (1 - zero) * rise)",
            low=Number(low), span=Number(high - low), zero=zero, rise=rise,
        )  # fmt: skip

    def _sensor_range(self, output: int, node: Node) -> Range:
        low, high = self.output_ranges[output]
        if isinstance(node, Name) and node.name in self.structure.equations.states:
            state = self.structure.equations.states.index(node.name)
            bottom, top = self.structure.low[state], self.structure.high[state]
            low = bottom if np.isfinite(bottom) else low
            high = top if np.isfinite(top) else high
        return low, high if high > low else low + 1.0


def expression(node: Node) -> Expression:
    """A tree as an expression."""
    return Expression("", node, names_in(node))


def inlined(system: Equations, e: Expression) -> Node:
    """An expression with the definitions put in."""
    known: dict[str, Node] = {}
    for name, definition in system.definitions:
        known[name] = substituted(definition.root, known)
    return substituted(e.root, known)


def _process(weights: Sequence[Node], place: Node) -> Node:
    terms = [
        formula(
            "w * exp(-0.5 * ((x - knot) / length) ** 2)",
            w=w, x=place, knot=Number(k / (KNOTS - 1)), length=Number(LENGTH),
        )
        for k, w in enumerate(weights)
    ]  # fmt: skip
    return total(terms)


def _rising(weights: Sequence[Node], place: Node) -> Node:
    """A curve through (0, 0) and (1, 1) whose slope is positive: linear between knots, the
    exponential of a Gaussian process at them."""
    slopes = [
        formula("exp(g)", g=_process(weights, Number(k / (KNOTS - 1)))) for k in range(KNOTS)
    ]
    parts, areas = [], []
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
