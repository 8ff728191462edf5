"""Registry of export targets."""

from __future__ import annotations

from typing import cast

from asia._plugins import Part, parts_of
from asia._text import suggestion
from asia.errors import UserError
from asia.export.target import Target
from asia.export.targets.c import CTarget
from asia.export.targets.casadi import CasadiTarget
from asia.export.targets.control import ControlTarget
from asia.export.targets.fmu import FmuTarget
from asia.export.targets.matlab import MatlabTarget
from asia.export.targets.numpy import NumpyTarget
from asia.export.targets.onnx import OnnxTarget

_GROUP = "asia.export_targets"

_ALL: tuple[Target, ...] = (
    NumpyTarget(),
    CTarget(),
    OnnxTarget(),
    FmuTarget(),
    CasadiTarget(),
    ControlTarget(),
    MatlabTarget(),
)
TARGETS: dict[str, Target] = {t.name: t for t in _ALL}
"""The built-in targets."""


def target_names() -> tuple[str, ...]:
    """Names that `--to` accepts: the built-in targets, then those of installed packages."""
    return (*TARGETS, *(part.name for part in parts_of(_GROUP) if part.name not in TARGETS))


def find_target(name: str) -> Target:
    """Return the target of that name. Raises UserError when there is none, an installed package
    brings something else by that name, or a program that the target needs is not installed."""
    plugged = {part.name: part for part in parts_of(_GROUP)}
    if name in TARGETS:
        found = TARGETS[name]
    elif name in plugged:
        found = _load(plugged[name])
    else:
        raise UserError(
            f"export target '{name}' is unknown{suggestion(name, target_names())} (installed are "
            f"{', '.join(target_names())})"
        )
    missing = found.missing()
    if missing is not None:
        raise UserError(f"--to {name}: {missing}")
    return found


def _load(part: Part) -> Target:
    make = part.load()
    found = make() if isinstance(make, type) else make
    methods = ("missing", "print", "run")
    if not all(callable(getattr(found, method, None)) for method in methods):
        raise UserError(
            f"{part.target} of package {part.package} {part.version} is {make!r}, expected an "
            "asia.export.target.Target, or its class, with missing(), print() and run()"
        )
    if getattr(found, "name", None) != part.name:
        raise UserError(
            f"export target '{part.name}' of package {part.package} calls itself "
            f"{getattr(found, 'name', None)!r}: give it the name of its entry point"
        )
    return cast("Target", found)
