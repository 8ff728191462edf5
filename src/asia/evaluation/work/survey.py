"""What the machines of an executor are fit for."""

from __future__ import annotations

import json
import os
import socket
import time
from collections.abc import Mapping
from dataclasses import dataclass

from asia.errors import SandboxError, UserError
from asia.evaluation.work.installation import check_installation, installation
from asia.executor import Carrier
from asia.sandbox import gpu_words, probe


@dataclass(frozen=True)
class MachineState:
    """One worker of an executor, as `asia doctor` tells it."""

    worker: str
    """What the executor calls it."""
    machine: str
    """Name of its machine."""
    cores: int
    """Cores of the machine."""
    isolation: str
    """The strongest level that works there; "" for none."""
    layers: tuple[str, ...]
    """Its layers."""
    round_trip: float
    """Seconds of a message there and back."""
    clock: float
    """Seconds by which its clock is ahead. Nothing depends on it."""
    unlike: str
    """What is not as on this machine, in a sentence; "" for nothing."""
    gpu: str
    """What the driver says of its GPU; "" for none."""


def survey_machines(carrier: Carrier) -> list[MachineState]:
    """Ask every worker. Raises SandboxError where one does not answer."""
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
                gpu=str(said["gpu"]),
            )
        )
    return states


def described(request: bytes) -> bytes:
    """On a worker: what it says of itself."""
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
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    said = {
        "machine": machine,
        "cores": cores or 1,
        "isolation": level,
        "layers": layers,
        "time": now,
        "unlike": unlike,
        "gpu": gpu_words(),
    }
    return json.dumps(said).encode()
