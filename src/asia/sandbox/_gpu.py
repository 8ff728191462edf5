"""Test whether sandboxed workers can compute on a GPU."""

from __future__ import annotations

from asia.candidate import Context
from asia.data import Signal
from asia.errors import CandidateError, SandboxError, UserError
from asia.sandbox._open import open_worker
from asia.sandbox._types import Isolation, Limits
from asia.sandbox.walls.gpu import gpu_nodes

_LIMITS = Limits(120.0, 60.0, 16384, gpu=True)
_MOST_WORDS = 200
DEVICES = ("auto", "cpu", "gpu")
"""Devices that a search may request."""
_OPEN = (
    "gpu: workers that train networks reach its driver at level {level}, through a filter that "
    "allows its commands, and have a limit on resident memory instead of addresses"
)
# Return JAX's name of the card, after a computation on it.
_TRIAL = """
import jax
import numpy as np


class Model:
    def simulate(self, past_u, past_y, u):
        return u


def fit(trajectories, context):
    device = jax.devices()[0]
    if device.platform != "gpu":
        raise RuntimeError(f"JAX computes on {device.platform}")
    total = jax.jit(lambda x: (x * x).sum())(np.arange(4.0, dtype="float32"))
    assert float(total) == 14.0
    print(device.device_kind)
    return Model()
"""


def chosen_gpu(asked: str, level: Isolation) -> tuple[str, tuple[str, ...]]:
    """Choose the GPU of a search.

    Args:
        asked: `auto` for a GPU where there is one, `cpu` or `gpu`

    Returns:
        JAX's name of the GPU, "" for none, and notes for the user

    Raises:
        UserError: for another word, and where `gpu` is requested and workers at `level` cannot
            reach one
    """
    if asked not in DEVICES:
        raise UserError(f"--device {asked}: expected {', '.join(DEVICES[:-1])} or {DEVICES[-1]}")
    if asked == "cpu" or (asked == "auto" and not gpu_nodes()):
        return "", ()
    try:
        return gpu_here(level), (_OPEN.format(level=level),)
    except SandboxError as error:
        if asked == "auto":
            return "", (f"gpu: not used, {error}",)
        raise UserError(
            f"--device gpu: {error}. Install NVIDIA's driver and JAX for CUDA (pip install "
            "'.[gpu]' in a clone of ASIA), check it with: asia doctor; or use --device cpu"
        ) from None


def gpu_here(level: Isolation) -> str:
    """Return JAX's name of the GPU that workers at `level` compute on.

    Raises:
        SandboxError: with the reason in plain words, where they cannot reach one
    """
    if not gpu_nodes():
        raise SandboxError("there is no device node /dev/nvidia0 with its driver")
    one = (Signal("u"),)
    try:
        with open_worker(level, _LIMITS, libraries=("jax",)) as worker:
            said = worker.fit(_TRIAL, [], Context(one, one, 1.0, 0, 0)).output
    except (CandidateError, SandboxError) as error:
        raise SandboxError(f"JAX does not reach it at level {level}: {_last(str(error))}") from None
    return _last(said) or "GPU"


def _last(words: str) -> str:
    """The last line, cut off where it is long."""
    lines = [line.strip() for line in words.splitlines() if line.strip()]
    return lines[-1][:_MOST_WORDS] if lines else ""
