"""Checks of the `[physics]` section, before anything is spent on it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import isfinite

from asia.errors import UserError
from asia.problem.physics.expressions import (
    FUNCTIONS,
    NAMED_NUMBERS,
    Expression,
    nearest,
    parse_expression,
)
from asia.problem.physics.types import Physics


def check_physics(physics: Physics, inputs: Sequence[str], outputs: Sequence[str]) -> None:
    """Raise UserError, naming the field, at the first thing that does not fit together.

    Args:
        inputs, outputs: the signal names of the problem
    """
    symbols = _symbols(physics, inputs)
    _check_ranges(physics)
    _check_priors(physics)
    _check_keys(physics, outputs)
    for where, text in _expressions(physics):
        _check_names(parse_expression(text, where), where, symbols)
    _check_corrections(physics)
    definition_order(physics)


def definition_order(physics: Physics) -> tuple[str, ...]:
    """Names of the definitions, each after those it uses.

    Raises:
        UserError: on a cycle
    """
    uses = {
        name: parse_expression(text, f"[physics.definitions] {name}").names
        & physics.definitions.keys()
        for name, text in physics.definitions.items()
    }
    ordered: list[str] = []
    while len(ordered) < len(uses):
        ready = [name for name in uses if name not in ordered and uses[name] <= set(ordered)]
        if not ready:
            cycle = sorted(set(uses) - set(ordered))
            raise UserError(
                f"[physics.definitions]: {', '.join(cycle)} refer to each other in a circle; "
                "write one of them in terms of states, inputs and parameters only"
            )
        ordered.extend(ready)
    return tuple(ordered)


def _symbols(physics: Physics, inputs: Sequence[str]) -> set[str]:
    """Everything an expression may name; refuses names that clash or cannot be written."""
    if not physics.states:
        raise UserError("[physics] states: at least one state is needed")
    owners: dict[str, str] = dict.fromkeys(FUNCTIONS, "a function")
    owners |= dict.fromkeys(NAMED_NUMBERS, "a number with a fixed name")
    groups = (
        ("an input", inputs, "inputs"),
        ("a state", physics.states, "[physics] states"),
        ("a parameter", physics.parameters, "[physics.parameters]"),
        ("a constant", physics.constants, "[physics.constants]"),
        ("a definition", physics.definitions, "[physics.definitions]"),
        ("a correction", physics.corrections, "[physics.corrections]"),
    )
    for kind, names, where in groups:
        for name in names:
            # An input whose name is not an identifier is of use to black-box models only.
            if not name.isidentifier() and kind != "an input":
                raise UserError(
                    f"{where}: '{name}' cannot be written in an expression; use letters, digits "
                    "and underscores"
                )
            if name in owners:
                raise UserError(f"{where}: '{name}' is already {owners[name]}; choose another name")
            owners[name] = kind
    return set(owners) - set(FUNCTIONS) - set(NAMED_NUMBERS)


def _check_ranges(physics: Physics) -> None:
    for name, value in physics.parameters.items():
        if not (isfinite(value.min) and isfinite(value.max) and value.min < value.max):
            raise UserError(
                f"[physics.parameters] {name}: min {value.min} must be below max {value.max}, "
                "both finite"
            )
    for name, constant in physics.constants.items():
        if not isfinite(constant):
            raise UserError(f"[physics.constants] {name}: expected a finite number")
    for name, bounds in physics.bounds.items():
        if name not in physics.states:
            raise UserError(
                f"[physics.bounds] {name}: there is no such state"
                f"{nearest(name, set(physics.states))}"
            )
        low, high = bounds.min, bounds.max
        if low is not None and high is not None and not low < high:
            raise UserError(f"[physics.bounds] {name}: min {low} must be below max {high}")


def _check_priors(physics: Physics) -> None:
    known = {*physics.parameters, *physics.constants}
    for text, prior in physics.priors.items():
        where = f"[physics.priors] {text}"
        expression = parse_expression(text, where)
        _check_names(expression, where, known)
        if not expression.names & set(physics.parameters):
            raise UserError(f"{where}: names no parameter; write an expression in parameters")
        if not (isfinite(prior.mean) and isfinite(prior.deviation) and prior.deviation > 0):
            raise UserError(
                f"{where}: expected a finite mean and a deviation above 0, got {prior.mean} and "
                f"{prior.deviation}"
            )


def _check_corrections(physics: Physics) -> None:
    used = {n for where, text in _expressions(physics) for n in parse_expression(text, where).names}
    for name, correction in physics.corrections.items():
        if name not in used:
            raise UserError(
                f"[physics.corrections] {name}: no equation uses it; write it where the unknown "
                "effect enters"
            )
        if not (isfinite(correction.scale) and correction.scale > 0):
            raise UserError(
                f"[physics.corrections] {name}: expected a scale above 0, its typical size"
            )


def _check_keys(physics: Physics, outputs: Sequence[str]) -> None:
    for name in physics.states:
        if name not in physics.dynamics:
            raise UserError(f"[physics.dynamics] {name}: missing; give d/dt of every state")
    for name in physics.dynamics:
        if name not in physics.states:
            raise UserError(
                f"[physics.dynamics] {name}: there is no such state"
                f"{nearest(name, set(physics.states))}"
            )
    for name in physics.observation:
        if name not in outputs:
            raise UserError(
                f"[physics.observation] {name}: there is no such output"
                f"{nearest(name, set(outputs))}"
            )
    for name in outputs:
        if name not in physics.observation and name not in physics.states:
            raise UserError(
                f"[physics.observation] {name}: missing; no state has this output's name, so say "
                "how it follows from the states"
            )


def _expressions(physics: Physics) -> list[tuple[str, str]]:
    sections: tuple[tuple[str, Mapping[str, str]], ...] = (
        ("definitions", physics.definitions),
        ("dynamics", physics.dynamics),
        ("observation", physics.observation),
    )
    return [
        (f"[physics.{section}] {name}", text)
        for section, entries in sections
        for name, text in entries.items()
    ]


def _check_names(expression: Expression, where: str, symbols: set[str]) -> None:
    for name in sorted(expression.names - symbols):
        what = "is a function: call it with its argument" if name in FUNCTIONS else None
        raise UserError(
            f"{where}: '{name}' {what}"
            if what
            else f"{where}: undefined symbol '{name}'{nearest(name, symbols)}"
        )
