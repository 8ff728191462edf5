"""Text of the equations of a trained grey-box, with the numbers put in."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from asia.data import Array
from asia.models._equations.config import GreyBoxStructure
from asia.models._equations.simulate import Effects, Scales
from asia.problem.physics.expressions import Binary, Call, Name, Negative, Node, Number

_LONGEST = 600
_STRENGTH = {"+": 1, "-": 1, "*": 2, "/": 2, "**": 4}
_OF_MINUS, _OF_NAMES = 3, 5


def equation_lines(structure: GreyBoxStructure, scales: Scales, effect: Effects) -> list[str]:
    """Definitions, dynamics, outputs, then the limits of states and the delays of inputs.

    Args:
        structure: grey-box.
        scales: sizes of the signals, as arrays (n,).
        effect: decoded coordinates, as arrays without rows.
    """
    system = structure.equations
    values = dict(system.constants) | {
        name: float(v) for name, v in zip(system.parameters, effect.parameters, strict=True)
    }
    lines = [f"{name} = {text(e.root, values)}" for name, e in system.definitions]
    for i, (name, e) in enumerate(zip(system.states, system.dynamics, strict=True)):
        added = _added(structure, scales, effect, i) if i < structure.nx_own else ""
        lines.append(f"d({name})/dt = {text(e.root, values)}{added}")
    for i, (name, e) in enumerate(zip(system.outputs, system.observation, strict=True)):
        shown = text(e.root, values)
        offset = float(effect.output_offset[i])
        if shown != name or offset:
            lines.append(f"{name} = {shown}{signed(offset) if offset else ''}")
    lines += _limits(structure, effect)
    if structure.config.input_delay:
        lines += [
            f"{name} acts {number(float(delay))} samples late"
            for name, delay in zip(system.inputs, effect.delay, strict=True)
        ]
    return [line if len(line) <= _LONGEST else f"{line[:_LONGEST]} ..." for line in lines]


def text(node: Node, values: Mapping[str, float]) -> str:
    """Text of an expression, with `values` in the place of their names."""
    return _text(node, values)[0]


def number(value: float) -> str:
    """Number with five digits."""
    return f"{value:.5g}"


def signed(value: float) -> str:
    """Number with its sign as operator: ` + 0.5` or ` - 0.5`."""
    return f" {'-' if value < 0 else '+'} {number(abs(value))}"


def _text(node: Node, values: Mapping[str, float]) -> tuple[str, int]:
    """Text of a tree, and the precedence of its operator."""
    match node:
        case Number(value):
            return number(value), _OF_NAMES if value >= 0 else _OF_MINUS
        case Name(name) if name in values:
            return _text(Number(values[name]), values)
        case Name(name):
            return name, _OF_NAMES
        case Negative(operand):
            return f"-{_inside(operand, values, _OF_MINUS)}", _OF_MINUS
        case Binary("-", Number(0.0), right):
            return f"-{_inside(right, values, _OF_MINUS)}", _OF_MINUS
        case Binary(symbol, left, right):
            strength = _STRENGTH[symbol]
            power = symbol == "**"
            first = _inside(left, values, strength + power)
            # a - (b + c), a / (b c): the right operand of a non-commutative operator keeps its
            # parentheses.
            second = _inside(right, values, strength + (symbol in "-/"))
            return f"{first}{symbol}{second}" if power else _pair(first, symbol, second), strength
        case Call(function, arguments):
            return f"{function}({', '.join(text(a, values) for a in arguments)})", _OF_NAMES


def _pair(first: str, symbol: str, second: str) -> str:
    if symbol in "+-" and second.startswith("-"):
        return f"{first} {'-' if symbol == '+' else '+'} {second[1:]}"
    return f"{first} {symbol} {second}"


def _inside(node: Node, values: Mapping[str, float], least: int) -> str:
    shown, strength = _text(node, values)
    return f"({shown})" if strength < least else shown


def _added(structure: GreyBoxStructure, scales: Scales, effect: Effects, i: int) -> str:
    """Terms that are added to the derivative of a state: linear term and offset in physical units,
    the network by its size."""
    config, own = structure.config, structure.nx_own
    rate = float(scales.rate[i])
    parts, constant = "", rate * float(effect.rate_offset[i])
    if config.linear:
        names = (*structure.equations.states[:own], *structure.equations.inputs)
        center = np.concatenate([scales.x_center[:own], scales.u_center])
        scale = np.concatenate([scales.x_scale[:own], scales.u_scale])
        slopes: Array = rate * effect.linear[i] / scale
        constant -= float(slopes @ center)
        parts = "".join(
            f"{signed(float(slope))} * {name}" for slope, name in zip(slopes, names, strict=True)
        )
    if constant:
        parts += signed(constant)
    if config.residual:
        parts += f" + network of {config.residual} tanh units in states and inputs"
    return parts


def _limits(structure: GreyBoxStructure, effect: Effects) -> list[str]:
    states: Sequence[str] = structure.equations.states
    lines: list[str] = []
    for i, name in enumerate(states):
        low, high = structure.low[i], min(structure.high[i], float(effect.limits[i]))
        sides = number(low) if math.isfinite(low) else "", number(high)
        if not math.isfinite(high):
            if sides[0]:
                lines.append(f"{name} >= {sides[0]}")
            continue
        lines.append(f"{sides[0]} <= {name} <= {sides[1]}" if sides[0] else f"{name} <= {sides[1]}")
        if float(effect.spill[i]) and i + 1 < structure.nx_own:
            share = number(float(effect.spill[i]))
            lines.append(f"of what {name} cannot hold, {share} times goes to {states[i + 1]}")
    return lines
