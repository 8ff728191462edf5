"""What two machines must have in common, so that a model fitted on one is the same on the other."""

from __future__ import annotations

import hashlib
import importlib.metadata
import platform
from collections.abc import Mapping
from functools import cache
from pathlib import Path

from asia.candidate import installed_libraries
from asia.errors import UserError
from asia.sandbox import Limits, gpu_words

_PACKAGES = ("cloudpickle", "jaxlib")
_GPU = "GPU"
_FLAGS = ("flags", "Features")


@cache
def installation() -> Mapping[str, str]:
    """Python, the packages that candidates may import, ASIA's own sources and the instructions of
    the processor, on which rounding depends."""
    names = sorted({*installed_libraries(), *_PACKAGES})
    return {
        "python": platform.python_version(),
        "processor": f"{platform.machine()} {_instructions()}",
        "asia": _sources(),
        **{name: _version(name) for name in names},
    }


def installation_for(limits: Limits) -> Mapping[str, str]:
    """The same, with the GPU where a worker computes on it: its rounding is another one."""
    return {**installation(), _GPU: gpu_words()} if limits.gpu else installation()


def check_installation(there: Mapping[str, str], machine: str) -> None:
    """Raises UserError unless this machine, by its name, has what the search's own has."""
    here = {**installation(), _GPU: gpu_words()} if _GPU in there else installation()
    different = [
        f"{name} {here.get(name, 'missing')} there, {there.get(name, 'missing')} here"
        for name in sorted({*here, *there})
        if here.get(name) != there.get(name)
    ]
    if different:
        raise UserError(
            f"worker machine {machine} is not like this one: {'; '.join(different)}. Install the "
            "same versions on all machines, and use machines with the same kind of processor: a "
            "model must come back bitwise the same"
        )


def _version(name: str) -> str:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return "missing"


def _instructions() -> str:
    """12 hexadecimal digits of what the processor offers, where the system says."""
    try:
        lines = Path("/proc/cpuinfo").read_text("utf-8", "replace").splitlines()
    except OSError:
        return platform.processor()
    found = next((line for line in lines if line.startswith(_FLAGS)), "")
    flags = " ".join(sorted(found.partition(":")[2].split()))
    return hashlib.sha256(flags.encode()).hexdigest()[:12]


def _sources() -> str:
    """12 hexadecimal digits of the sources of this package."""
    digest = hashlib.sha256()
    root = Path(__file__).parents[2]
    for path in sorted(root.rglob("*.py")):
        digest.update(f"{path.relative_to(root).as_posix()}\n".encode() + path.read_bytes())
    return digest.hexdigest()[:12]
