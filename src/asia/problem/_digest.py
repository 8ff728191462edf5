"""sha256 digests of the inputs of a search."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict
from typing import Any

from asia.problem._problem import Problem
from asia.problem.physics.types import Physics
from asia.problem.symmetry import Symmetry
from asia.protocol._rules import ProtocolRule

# Tables that count only where they hold something: a digest outlives additions to the rules.
_LATER = ("priors", "corrections")


def protocol_digest(problem: Problem) -> str:
    """Return the sha256 (hex) of the protocol with its defaults filled in.

    Absent settings do not count, so that a digest survives additions to the rules.
    """
    rule = asdict(problem.protocol)
    if problem.protocol.residuals == ProtocolRule.residuals:
        del rule["residuals"]
    return _of_json(_present(rule))


def physics_digest(physics: Physics) -> str:
    """Hex sha256 of the equations, ranges, bounds, and the priors and corrections there are."""
    tables = asdict(physics)
    return _of_json({k: v for k, v in tables.items() if v or k not in _LATER})


def symmetry_digest(symmetry: Symmetry) -> str:
    """Hex sha256 of the generators."""
    return _of_json({name: dict(generator) for name, generator in symmetry.items()})


def text_digest(text: str) -> str:
    """Hex sha256 of the text as UTF-8."""
    return hashlib.sha256(text.encode()).hexdigest()


def _present(value: Any) -> Any:
    """Mappings without their entries that are None or an empty tuple."""
    if isinstance(value, dict):
        return {k: _present(v) for k, v in value.items() if v is not None and v != ()}
    if isinstance(value, tuple):
        return [_present(v) for v in value]
    return value


def _of_json(value: Any) -> str:
    return text_digest(json.dumps(value, sort_keys=True))
