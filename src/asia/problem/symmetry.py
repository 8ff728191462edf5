"""Symmetries of a system: changes of its signals that leave its laws as they are.

A generator is a signed permutation: `{"wx": "wy", "wy": "-wx"}` says that the records of another
experiment are had by reading wy as wx and -wx as wy. Signals that it does not name stay.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np

from asia._text import suggestion
from asia.data.trajectory import Array
from asia.errors import UserError
from asia.problem.physics import Physics

Symmetry = Mapping[str, Mapping[str, str]]
"""Generators by name: each signal's new value, the name of a signal with or without a minus."""

MOST_ELEMENTS = 64
"""Elements of a group; more are refused."""


def check_symmetry(
    symmetry: Symmetry,
    inputs: Sequence[str],
    outputs: Sequence[str],
    physics: Physics | None,
) -> None:
    """Check a symmetry against the signals of a problem.

    Valid names are inputs, outputs, and with physics its states, definitions and corrections.

    Raises:
        UserError: naming the entry, for an unknown signal, for a map that is no permutation,
            and for a group that is too large
    """
    known = [*inputs, *outputs]
    if physics is not None:
        known += [*physics.states, *physics.definitions, *physics.corrections]
    known = list(dict.fromkeys(known))
    for name, generator in symmetry.items():
        where = f"[symmetry.{name}]"
        for signal in (*generator, *(_unsigned(value) for value in generator.values())):
            if signal not in known:
                raise UserError(
                    f"{where}: there is no signal '{signal}'{suggestion(signal, known)}; expected "
                    "an input, an output, a state, a definition or a correction"
                )
        if sorted(generator) != sorted(_unsigned(value) for value in generator.values()):
            raise UserError(
                f"{where}: is no permutation: every signal named must be on the left of one entry "
                "and, with or without a minus, on the right of one"
            )
    group(symmetry, known)


def group(symmetry: Symmetry, names: Sequence[str]) -> Array:
    """All products of the generators as matrices (G, n, n) that act on the signals `names`, the
    identity first.

    Raises:
        UserError: when a generator takes a named signal to another one, and for more than
            MOST_ELEMENTS elements
    """
    identity = np.eye(len(names))
    found = [identity]
    seen = {identity.tobytes()}
    generators: list[Array] = []
    for generator in symmetry.values():
        matrix = np.eye(len(names))
        for row, name in enumerate(names):
            if name not in generator:
                continue
            value = generator[name]
            other = _unsigned(value)
            if other not in names:
                raise UserError(
                    f"[symmetry]: '{name}' becomes '{value}', which is not among {', '.join(names)}"
                )
            matrix[row] = 0.0
            matrix[row, names.index(other)] = -1.0 if value.startswith("-") else 1.0
        # -0.0 and 0.0 are one element.
        generators.append(matrix + 0.0)
    for element in found:
        for generator in generators:
            turned = generator @ element
            if turned.tobytes() not in seen:
                seen.add(turned.tobytes())
                found.append(turned)
            if len(found) > MOST_ELEMENTS:
                raise UserError(
                    f"[symmetry]: the group has more than {MOST_ELEMENTS} elements; leave out a "
                    "generator"
                )
    return np.array(found)


def of_signals(symmetry: Symmetry, inputs: Collection[str], outputs: Collection[str]) -> Symmetry:
    """The generators that take inputs to inputs and outputs to outputs and name nothing else: those
    that a model without equations can have."""
    sides = ({*inputs}, {*outputs})
    return {
        name: generator
        for name, generator in symmetry.items()
        if generator
        and all(
            any({signal, _unsigned(value)} <= side for side in sides)
            for signal, value in generator.items()
        )
    }


def _unsigned(value: str) -> str:
    return value.removeprefix("-").strip()
