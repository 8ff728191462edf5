"""Equations as text: `[physics]` of a problem file, for candidates that bring their own."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, fields
from functools import lru_cache

from pydantic import ConfigDict, with_config

from asia.problem.physics import Physics
from asia.problem.toml import parse_table, toml_value


@with_config(ConfigDict(extra="forbid", strict=True, allow_inf_nan=False))
class _Table(Physics):
    """`[physics]`."""


@lru_cache(maxsize=64)
def read_physics(text: str) -> Physics:
    """Read equations.

    Args:
        text: the tables of `[physics]`, without `physics.` in their names

    Raises:
        UserError: for an unknown key, and a value of another type
    """
    table = parse_table(text, _Table, "physics")
    return Physics(**{one.name: getattr(table, one.name) for one in fields(Physics)})


def written_physics(physics: Physics, prefix: str = "") -> str:
    """Write equations, one line each.

    Args:
        prefix: put before the names of the tables, such as "physics."
    """
    lines: list[str] = []
    for name, value in asdict(physics).items():
        if isinstance(value, Mapping):
            if value:
                lines.append(f"[{prefix}{name}]")
                lines += [f"{key} = {toml_value(one)}" for key, one in value.items()]
        else:
            lines.append(f"{name} = {toml_value(list(value))}")
    return "\n".join(lines) + "\n"
