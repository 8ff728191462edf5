"""Libraries that come with an extra."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Any

from asia.errors import UserError


def need(module: str, path: Path, extra: str) -> Any:
    """A library that comes with an extra.

    Raises:
        UserError: that says how to get it
    """
    try:
        return import_module(module)
    except ImportError:
        raise UserError(
            f"{path} needs the package {module.partition('.')[0]}: "
            f"pip install '.[{extra}]' in a clone of ASIA"
        ) from None
