"""Access to an NVIDIA GPU for a worker: device nodes, files that the driver reads, environment.

Written from documentation, and not run on a GPU.
"""

from __future__ import annotations

import os
from pathlib import Path

_DEVICES = Path("/dev")
_DRIVER_NODES = ("nvidiactl", "nvidia-uvm", "nvidia-uvm-tools")
# The kind of card, the bus it is on, which cores are near it. No data of anybody.
GPU_FACTS = ("/proc/driver/nvidia", "/proc/devices", "/sys/bus/pci", "/sys/devices")
_CHOSEN = "CUDA_VISIBLE_DEVICES"


def gpu_nodes(folder: Path = _DEVICES) -> tuple[str, ...]:
    """Device nodes of the cards and of their driver; () where there is no NVIDIA GPU."""
    cards = sorted(str(node) for node in folder.glob("nvidia[0-9]*"))
    driver = [str(folder / name) for name in _DRIVER_NODES if (folder / name).exists()]
    return (*cards, *driver) if cards and driver else ()


def gpu_environment(flags: str) -> dict[str, str]:
    """Environment variables of a worker on a GPU, in place of those for the processor.

    JAX ends with an error where it does not reach the GPU; it takes memory as it needs it, since
    several workers share a card; sums come out the same each time.

    Args:
        flags: those of XLA for the processor
    """
    chosen = os.environ.get(_CHOSEN)
    return {
        "JAX_PLATFORMS": "cuda",
        "XLA_PYTHON_CLIENT_PREALLOCATE": "false",
        "XLA_FLAGS": f"{flags} --xla_gpu_deterministic_ops=true --xla_gpu_autotune_level=0",
        "CUDA_CACHE_DISABLE": "1",
        **({} if chosen is None else {_CHOSEN: chosen}),
    }


def gpu_description() -> str:
    """Cards and driver, as the driver says; "" where it says nothing."""
    found: list[str] = []
    for file in sorted(Path("/proc/driver/nvidia/gpus").glob("*/information")):
        found += [line.partition(":")[2].strip() for line in _lines(file) if "Model" in line]
    found += _lines(Path("/proc/driver/nvidia/version"))[:1]
    return "; ".join(found)


def _lines(file: Path) -> list[str]:
    try:
        return file.read_text("utf-8", "replace").splitlines()
    except OSError:
        return []
