"""What outcomes and prompts may depend on beside the problem: Python, packages, the library."""

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
    """Python, platform and the versions of the packages that outcomes or prompts may depend on,
    those that bring parts included, and the digest of the model library, which may change between
    two versions. gpu: what candidates compute on beside the processor. Raises UserError as
    `asia._plugins.parts` does."""
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
    """What differs between the environment in a ledger and the one here, one sentence each."""
    return tuple(
        f"{name} {here.get(name, 'missing')} here, {there.get(name, _absent(name))} then"
        for name in sorted({**there, **here})
        if here.get(name) != there.get(name)
    )


def _absent(name: str) -> str:
    return "not recorded" if name == "asia.models" else "missing"
