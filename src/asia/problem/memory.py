"""Operators with memory in the equations, written as hidden states and transport delays."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

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

NOTHING = Number(0.0)


@dataclass(frozen=True)
class TransportDelay:
    """Signal behind a volume that it flows through unmixed: the parcel that leaves now entered when
    the flow since then was still equal to the volume. A delay has a flow of 1. So has a lag, whose
    volume is mixed."""

    name: str  # Name of the delayed signal in the other expressions
    value: Node  # Signal that enters
    flow: Node  # Volume a second; below 0 it counts as 0
    volume: Node  # Volume; below 0 it counts as 0
    ahead: bool = False
    """The signal is read at the middle of a step, not at its start."""
    mean: bool = False  # Mean over the volume instead of what leaves it
    mixed: bool = False  # The volume is mixed, and the signal is its mean over a step
    dispersion: Node = NOTHING
    """Half the variance of the volume that parcels flow through, relative to the volume."""

    @property
    def uniform(self) -> bool:
        """Each sample enters the same volume, and leaves it as it was."""
        plain = not (self.mean or self.mixed) and self.dispersion == NOTHING
        return isinstance(self.flow, Number) and plain

    @property
    def call(self) -> Node:
        """The operator as the problem file writes it."""
        if self.uniform or self.mixed:
            return Call("lag" if self.mixed else "delay", (self.value, self.volume))
        spread = () if self.dispersion == NOTHING else (self.dispersion,)
        function = "plug_mean" if self.mean else "plug_flow"
        return Call(function, (self.value, self.flow, self.volume, *spread))

    @property
    def parts(self) -> tuple[Node, Node, Node, Node]:
        """Entering signal, flow, volume and dispersion."""
        return self.value, self.flow, self.volume, self.dispersion


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
        self._known: dict[object, str] = {}
        self._hidden: dict[str, tuple[Node, Node]] = {}  # derivative and value at rest
        self._delays: list[TransportDelay] = []
        self._constant = {*physics.parameters, *physics.constants, *physics.corrections}
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
        rates = [part for both in self._hidden.values() for part in both]
        read = frozenset[str]().union(*map(self._closure, (*dynamics, *observation, *rates)))
        delays = list[TransportDelay]()
        # Each comes after those that it reads.
        for one in reversed(self._delays):
            if one.name in read:
                delays.insert(0, one)
                read = read.union(*map(self._closure, one.parts))
        driven = [d for d in delays if d.name not in self._dynamic]
        return Expanded(
            definitions=tuple(self._plain.items()),
            states=(*physics.states, *self._hidden),
            dynamics=(*dynamics, *(rate for rate, _ in self._hidden.values())),
            observation=tuple(observation),
            rest=tuple(rest for _, rest in self._hidden.values()),
            delays=(*driven, *(d for d in delays if d.name in self._dynamic)),
            driven=len(driven),
        )

    def _of(self, node: Node, ahead: bool, entering: bool = False) -> Node:
        """The tree without calls that have memory.

        Args:
            ahead: whether it is part of a derivative
            entering: whether it enters a delay
        """
        match node:
            case Name(name) if name in self._remembering:
                return self._of(self._remembering[name], ahead, entering)
            case Name() | Number():
                return node
            case Negative(operand):
                return Negative(self._of(operand, ahead, entering))
            case Binary(symbol, left, right):
                left, right = (self._of(part, ahead, entering) for part in (left, right))
                return Binary(symbol, left, right)
            case Call("lag", (x, time)):
                return self._lag(x, time, entering)
            case Call("delay", (x, time)):
                value, time = self._entering(x), self._entering(time)
                return self._delay(TransportDelay("", value, Number(1.0), time), ahead)
            case Call("plug_flow" | "plug_mean" as kind, (x, flow, volume, *spread)):
                value, flow, volume = map(self._entering, (x, flow, volume))
                dispersion = self._entering(spread[0]) if spread else NOTHING
                found = TransportDelay("", value, flow, volume, dispersion=dispersion)
                return self._delay(replace(found, mean=kind == "plug_mean"), ahead)
            case Call(function, arguments):
                return Call(function, tuple(self._of(a, ahead, entering) for a in arguments))

    def _entering(self, part: Node) -> Node:
        return self._of(part, False, True)

    def _lag(self, x: Node, time: Node, entering: bool) -> Node:
        """Hidden state that follows x with a time constant; what enters a delay and depends on
        inputs alone is known without a state."""
        if entering:
            value, span = self._entering(x), self._entering(time)
            if not self._reads((value, span), self._dynamic):
                found = TransportDelay("", value, Number(1.0), span, mixed=True)
                return self._delay(found, False)
        x, time = self._of(x, True), self._of(time, True)
        key = "lag", x, time
        if key not in self._known:
            name = f"lag {1 + len(self._hidden)}"
            self._known[key] = name
            through = Call("max", (time, Name(LEAST_TIME)))
            self._dynamic.add(name)
            if self._reads((x, time), self._moving):
                self._moving.add(name)
            self._hidden[name] = Binary("/", Binary("-", x, Name(name)), through), x
        return Name(self._known[key])

    def _reads(self, nodes: Sequence[Node], names: set[str]) -> frozenset[str]:
        return frozenset[str]().union(*map(self._closure, nodes)) & names

    def _delay(self, one: TransportDelay, ahead: bool) -> Node:
        if self._closure(one.value) <= self._constant | self._plain.keys():
            return one.value
        dynamic = bool(self._reads(one.parts, self._dynamic))
        if moving := self._reads(one.parts[1:], self._moving):
            raise UserError(
                "[physics]: the time of a delay, and the flow and volume of a plug flow, depend on "
                f"inputs and parameters only, not on '{min(moving)}', which depends on a state"
            )
        key = one = replace(one, ahead=ahead and (dynamic or one.mean))
        if key not in self._known:
            name = f"delayed {len(self._delays) + 1}"
            self._known[key] = name
            if dynamic:
                self._dynamic.add(name)
            if self._reads((one.value,), self._moving):
                self._moving.add(name)
            self._delays.append(replace(one, name=name))
        return Name(self._known[key])

    def _closure(self, node: Node) -> frozenset[str]:
        """Names that a tree depends on, definitions followed."""
        found = names_in(node)
        for name in found & self._plain.keys():
            found |= self._closure(self._plain[name])
        return found


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
