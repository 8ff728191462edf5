"""Operators with memory in the equations, written as hidden states and transport delays."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass

from asia.errors import UserError
from asia.problem.physics import (
    MEMORY,
    Binary,
    Call,
    Name,
    Negative,
    Node,
    Number,
    Physics,
    definition_order,
    names_in,
    parse_expression,
)

LEAST_TIME = "least time constant"
"""Constant below which a time constant acts as if it were equal to it: 0 until a model knows what
its integrator can follow."""

# Cells in series that mix what leaves a plug flow.
_CELLS = 3


@dataclass(frozen=True)
class TransportDelay:
    """Signal behind a volume that it flows through unmixed: the parcel that leaves now entered when
    the flow since then was still equal to the volume. A delay has a flow of 1."""

    name: str  # Name of the delayed signal in the other expressions
    value: Node  # Signal that enters
    flow: Node  # Volume a second; below 0 it counts as 0
    volume: Node  # Volume; below 0 it counts as 0
    ahead: bool = False
    """The signal is read at the middle of a step, not at its start."""
    mean: bool = False  # Mean over the volume instead of what leaves it

    @property
    def uniform(self) -> bool:
        """Each sample enters the same volume."""
        return isinstance(self.flow, Number) and not self.mean

    @property
    def call(self) -> Node:
        """The operator as the problem file writes it."""
        if self.uniform:
            return Call("delay", (self.value, self.volume))
        function = "plug_mean" if self.mean else "plug_flow"
        return Call(function, (self.value, self.flow, self.volume))


@dataclass(frozen=True)
class Expanded:
    """Equations of a problem without operators that have memory."""

    definitions: tuple[tuple[str, Node], ...]  # Each after those it uses
    states: tuple[str, ...]  # States of the problem file, then hidden ones
    dynamics: tuple[Node, ...]  # d/dt of each state
    observation: tuple[Node, ...]  # Expression of each output
    rest: tuple[Node, ...]  # Value at rest of each hidden state
    delays: tuple[TransportDelay, ...]
    """Each after those it reads; first those that read no state."""
    driven: int  # Number of delays that read no state


def has_memory(physics: Physics) -> bool:
    """Whether an equation calls an operator that remembers past samples."""
    return _is_called(physics, MEMORY)


def delays_signals(physics: Physics) -> bool:
    """Whether an equation calls such an operator other than `lag`."""
    return _is_called(physics, MEMORY.keys() - {"lag"})


def _is_called(physics: Physics, operators: Collection[str]) -> bool:
    texts = *physics.definitions.values(), *physics.dynamics.values(), *physics.observation.values()
    roots = (parse_expression(t, "[physics]", memory=True).root for t in texts)
    return any(_calls(root, operators) for root in roots)


def expanded(physics: Physics, outputs: Sequence[str]) -> Expanded:
    """Write each operator with memory of checked equations as a hidden state or a delay."""
    return _Expansion(physics).result(outputs)


class _Expansion:
    def __init__(self, physics: Physics) -> None:
        self._physics = physics
        self._plain: dict[str, Node] = {}
        self._remembering: dict[str, Node] = {}
        for name in definition_order(physics):
            node = _parsed(physics.definitions, name, "definitions")
            has = _calls(node) or not names_in(node).isdisjoint(self._remembering)
            (self._remembering if has else self._plain)[name] = node
        self._known: dict[tuple[object, ...], str] = {}
        self._hidden: dict[str, tuple[Node, Node]] = {}  # derivative and value at rest
        self._delays: list[TransportDelay] = []
        # Signals that depend on any state, and on a state of the problem file.
        self._dynamic, self._moving = {*physics.states}, {*physics.states}

    def result(self, outputs: Sequence[str]) -> Expanded:
        physics = self._physics
        dynamics = [
            self._of(_parsed(physics.dynamics, name, "dynamics"), True) for name in physics.states
        ]
        observation = [
            self._of(_parsed(physics.observation, name, "observation"), False) for name in outputs
        ]
        driven = [d for d in self._delays if d.name not in self._dynamic]
        return Expanded(
            definitions=tuple(self._plain.items()),
            states=(*physics.states, *self._hidden),
            dynamics=(*dynamics, *(rate for rate, _ in self._hidden.values())),
            observation=tuple(observation),
            rest=tuple(rest for _, rest in self._hidden.values()),
            delays=(*driven, *(d for d in self._delays if d.name in self._dynamic)),
            driven=len(driven),
        )

    def _of(self, node: Node, ahead: bool) -> Node:
        """The tree without calls that have memory; `ahead` where it is part of a derivative."""
        match node:
            case Name(name) if name in self._remembering:
                return self._of(self._remembering[name], ahead)
            case Name() | Number():
                return node
            case Negative(operand):
                return Negative(self._of(operand, ahead))
            case Binary(symbol, left, right):
                return Binary(symbol, self._of(left, ahead), self._of(right, ahead))
            case Call("lag", (x, time)):
                return self._lag(self._of(x, True), self._of(time, True))
            case Call("delay", (x, time)):
                return self._delay(self._of(x, False), Number(1.0), self._of(time, False), ahead)
            case Call("plug_flow" | "plug_mean" as kind, (x, flow, volume)):
                entering, pace, size = (self._of(part, False) for part in (x, flow, volume))
                return self._delay(entering, pace, size, ahead, mean=kind == "plug_mean")
            case Call("plug_flow", (x, flow, volume, dispersion)):
                entering, pace, size = (self._of(part, False) for part in (x, flow, volume))
                return self._dispersed(entering, pace, size, self._of(dispersion, True))
            case Call(function, arguments):
                return Call(function, tuple(self._of(a, ahead) for a in arguments))

    def _lag(self, x: Node, time: Node) -> Node:
        return self._state("lag", x, Call("max", (time, Name(LEAST_TIME))))

    def _state(self, kind: str, x: Node, time: Node) -> Node:
        """Hidden state that follows x with a time constant."""
        key = kind, x, time
        if key not in self._known:
            name = f"{kind} {1 + sum(n.startswith(f'{kind} ') for n in self._hidden)}"
            self._known[key] = name
            self._hide(name, Binary("/", Binary("-", x, Name(name)), time), x)
        return Name(self._known[key])

    def _hide(self, name: str, rate: Node, rest: Node) -> None:
        self._dynamic.add(name)
        if self._reads((rest, rate), self._moving):
            self._moving.add(name)
        self._hidden[name] = rate, rest

    def _reads(self, nodes: Sequence[Node], names: set[str]) -> frozenset[str]:
        return frozenset[str]().union(*map(self._closure, nodes)) & names

    def _delay(self, x: Node, flow: Node, volume: Node, ahead: bool, *, mean: bool = False) -> Node:
        dynamic = bool(self._reads((x, flow, volume), self._dynamic))
        if moving := self._reads((flow, volume), self._moving):
            raise UserError(
                "[physics]: the time of a delay, and the flow and volume of a plug flow, depend on "
                f"inputs and parameters only, not on '{min(moving)}', which depends on a state"
            )
        ahead = ahead and (dynamic or mean)
        key = x, flow, volume, ahead, mean
        if key not in self._known:
            name = f"delayed {len(self._delays) + 1}"
            self._known[key] = name
            if dynamic:
                self._dynamic.add(name)
            if self._reads((x,), self._moving):
                self._moving.add(name)
            self._delays.append(TransportDelay(name, x, flow, volume, ahead, mean))
        return Name(self._known[key])

    def _dispersed(self, x: Node, flow: Node, volume: Node, dispersion: Node) -> Node:
        """Plug flow through one part of the volume, then mixed cells through the rest: the variance
        of the residence time is twice the dispersion, relative to the square of its mean, up to one
        third. Source: Levenspiel, Chemical Reaction Engineering, 3rd ed., 1999, eq. 13.8."""
        share = Call("min", (Call("sqrt", (_product(2.0 * _CELLS, dispersion),)), Number(1.0)))
        least = Binary("*", Call("max", (flow, Number(0.0))), Name(LEAST_TIME))
        cell = Call("max", (Binary("/", Binary("*", volume, share), Number(float(_CELLS))), least))
        found = self._delay(x, flow, Binary("-", volume, _product(_CELLS, cell)), True)
        for _ in range(_CELLS):
            key = "cell", found, cell
            if key not in self._known:
                name = f"cell {len([k for k in self._known if k[0] == 'cell']) + 1}"
                self._known[key] = name
                through = Binary("/", Call("max", (flow, Number(0.0))), cell)
                rate = Binary("*", through, Binary("-", found, Name(name)))
                self._hide(name, rate, x)
            found = Name(self._known[key])
        return found

    def _closure(self, node: Node) -> frozenset[str]:
        """Names that a tree depends on, definitions followed."""
        found = names_in(node)
        for name in found & self._plain.keys():
            found |= self._closure(self._plain[name])
        return found


def _product(factor: float, node: Node) -> Node:
    return Binary("*", Number(float(factor)), node)


def _parsed(texts: Mapping[str, str], name: str, section: str) -> Node:
    return parse_expression(texts.get(name, name), f"[physics.{section}] {name}", memory=True).root


def _calls(node: Node, operators: Collection[str] = MEMORY) -> bool:
    return any(isinstance(n, Call) and n.function in operators for n in _nodes(node))


def _nodes(node: Node) -> Iterator[Node]:
    yield node
    match node:
        case Negative(operand):
            yield from _nodes(operand)
        case Binary(_, left, right):
            yield from _nodes(left)
            yield from _nodes(right)
        case Call(_, arguments):
            for argument in arguments:
                yield from _nodes(argument)
        case Name() | Number():
            pass
