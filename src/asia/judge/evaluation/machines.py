"""Compare worker machines with this one: a model must come back bitwise the same from each."""

import hashlib
import json
import platform
import socket
import time
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from asia._plugins import version_of
from asia.candidate import installed_libraries
from asia.errors import SandboxError, UserError
from asia.judge.executors import RemoteExecutor, local_cores
from asia.judge.sandbox.availability import probe


@cache
def installation() -> Mapping[str, str]:
    """Python, the packages that candidates may import, ASIA's own sources and the instructions of
    the processor, on which rounding depends."""
    names = sorted({*installed_libraries(), "cloudpickle", "jaxlib"})
    return {
        "python": platform.python_version(),
        "processor": f"{platform.machine()} {_instructions()}",
        "asia": _sources(),
        **{name: version_of(name) for name in names},
    }


def check_installation(there: Mapping[str, str], machine: str) -> None:
    """Raise UserError unless the installation on a machine equals that of the search."""
    here = installation()
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


def _instructions() -> str:
    """Return 12 hexadecimal digits of the processor's instruction sets, where the system lists
    them."""
    try:
        lines = Path("/proc/cpuinfo").read_text("utf-8", "replace").splitlines()
    except OSError:
        return platform.processor()
    found = next((line for line in lines if line.startswith(("flags", "Features"))), "")
    flags = " ".join(sorted(found.partition(":")[2].split()))
    return hashlib.sha256(flags.encode()).hexdigest()[:12]


def _sources() -> str:
    digest = hashlib.sha256()
    root = Path(__file__).parents[2]
    for path in sorted(root.rglob("*.py")):
        digest.update(f"{path.relative_to(root).as_posix()}\n".encode() + path.read_bytes())
    return digest.hexdigest()[:12]


@dataclass(frozen=True)
class MachineState:
    """State of one worker of an executor, for `asia doctor`."""

    worker: str
    machine: str
    cores: int
    isolation: str
    """The strongest level that works there; "" for none."""
    layers: tuple[str, ...]
    round_trip: float
    """Seconds of a message there and back."""
    clock: float
    """Seconds by which its clock is ahead. Nothing depends on it."""
    unlike: str
    """Differences from this machine, in a sentence; "" for none."""


def survey_machines(carrier: RemoteExecutor) -> list[MachineState]:
    """Query every worker. Raises SandboxError where one does not respond."""
    request = json.dumps(dict(installation())).encode()
    states: list[MachineState] = []
    for worker, (reply, seconds, asked) in carrier.ask_each(described, request).items():
        said: dict[str, object] = json.loads(reply)
        states.append(
            MachineState(
                worker=worker,
                machine=str(said["machine"]),
                cores=int(str(said["cores"])),
                isolation=str(said["isolation"]),
                layers=tuple(str(said["layers"]).split()),
                round_trip=seconds,
                clock=float(str(said["time"])) - asked - seconds / 2,
                unlike=str(said["unlike"]),
            )
        )
    return states


def described(request: bytes) -> bytes:
    """Describe this machine, on a worker."""
    there: Mapping[str, str] = json.loads(request)
    machine, now = socket.gethostname(), time.time()
    try:
        check_installation(there, machine)
        unlike = ""
    except UserError as error:
        unlike = str(error)
    try:
        found = probe()
        level, layers = found.level.value, " ".join(layer.value for layer in found.layers)
    except SandboxError:
        level, layers = "", ""
    said = {
        "machine": machine,
        "cores": local_cores(),
        "isolation": level,
        "layers": layers,
        "time": now,
        "unlike": unlike,
    }
    return json.dumps(said).encode()
