"""Export targets by name."""

from __future__ import annotations

from asia.errors import UserError
from asia.export._target import Target
from asia.export.targets.c import CTarget
from asia.export.targets.casadi import CasadiTarget
from asia.export.targets.control import ControlTarget
from asia.export.targets.fmu import FmuTarget
from asia.export.targets.matlab import MatlabTarget
from asia.export.targets.numpy import NumpyTarget
from asia.export.targets.onnx import OnnxTarget

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
"""All targets that `--to` accepts."""


def target(name: str) -> Target:
    """Return the target of a name.

    Raises:
        UserError: if there is no such target, or something that it needs is not installed.
    """
    if name not in TARGETS:
        raise UserError(f"target '{name}' is unknown, expected one of {', '.join(TARGETS)}")
    found = TARGETS[name]
    missing = found.missing()
    if missing is not None:
        raise UserError(f"--to {name}: {missing}")
    return found
