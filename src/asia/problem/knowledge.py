"""Prior knowledge of a problem file next to the equations, as lines for users and agents."""

from __future__ import annotations

from collections.abc import Iterator

from asia._text import one_line
from asia.problem.physics.types import Physics
from asia.problem.symmetry import Symmetry

_TEXT = 400


def prior_lines(physics: Physics) -> Iterator[str]:
    """One a prior: the combination of parameters, its value and the reason."""
    for text, prior in physics.priors.items():
        reason = f": {one_line(prior.reason, _TEXT)}" if prior.reason else ""
        yield f"{one_line(text, _TEXT)} = {prior.mean:g} +- {prior.deviation:g}{reason}"


def correction_lines(physics: Physics) -> Iterator[str]:
    """One a place in the equations where an unknown effect enters, with its typical size."""
    for name, correction in physics.corrections.items():
        yield f"{name}: unknown, about {correction.scale:g} large"


def symmetry_lines(symmetry: Symmetry) -> Iterator[str]:
    """Describe each generator: every signal and the signal that replaces it."""
    for name, generator in symmetry.items():
        changes = ", ".join(f"{signal} -> {value}" for signal, value in generator.items())
        yield f"{name.replace('_', ' ')}: {one_line(changes, 2 * _TEXT)}"
