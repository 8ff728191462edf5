"""Environment that outcomes and prompts depend on: Python, packages, model library."""

from __future__ import annotations

import hashlib
import importlib.metadata
import platform
from collections.abc import Mapping
from functools import cache
from pathlib import Path

from asia._plugins import parts
from asia.agents import packages_of
from asia.candidate import installed_libraries

PACKAGES = ("cloudpickle", "asia-sysid")


def environment(*agents: str, gpu: str = "") -> dict[str, str]:
    """Return the environment that outcomes and prompts may depend on.

    Args:
        gpu: device of the candidates besides the processor.

    Returns:
        Python, platform, versions of packages and plugins, and the digest of the model library.

    Raises:
        UserError: as `asia._plugins.parts`.
    """
    names = (
        *installed_libraries(),
        *PACKAGES,
        *(package for name in agents for package in packages_of(name)),
    )
    versions = {name: importlib.metadata.version(name) for name in names}
    plugged = {part.package: part.version for part in parts()}
    python = {"python": platform.python_version(), "platform": platform.platform()}
    card = {"GPU": gpu} if gpu else {}
    return {**python, **plugged, **versions, **card, "asia.models": _library_digest()}


@cache
def _library_digest() -> str:
    """12 hexadecimal digits of the sources of `asia.models`."""
    digest = hashlib.sha256()
    root = Path(__file__).parents[1] / "models"
    for path in sorted(root.rglob("*.py")):
        digest.update(f"{path.relative_to(root).as_posix()}\n".encode() + path.read_bytes())
    return digest.hexdigest()[:12]


def environment_changes(there: Mapping[str, str], here: Mapping[str, str]) -> tuple[str, ...]:
    """Describe the differences between the recorded and the present environment, one sentence
    each.
    """
    return tuple(
        f"{name} {here.get(name, 'missing')} here, {there.get(name, _absent(name))} then"
        for name in sorted({**there, **here})
        if here.get(name) != there.get(name)
    )


def _absent(name: str) -> str:
    return "not recorded" if name == "asia.models" else "missing"
