"""The layers that a worker puts on itself: whether this kernel gives them, and how to get them."""

from __future__ import annotations

import sys

from asia.sandbox._types import Layer
from asia.sandbox.walls import landlock, seccomp

ANOTHER_SYSTEM = "use a Linux machine, or a Linux virtual machine on this one"


def missing_layers() -> dict[Layer, str]:
    """Return the layers that a worker cannot put on itself here, with reasons."""
    if sys.platform != "linux":
        return {Layer.LANDLOCK: "Landlock needs Linux", Layer.SECCOMP: "seccomp needs Linux"}
    reasons = {Layer.LANDLOCK: landlock.why_not(), Layer.SECCOMP: seccomp.why_not()}
    return {layer: reason for layer, reason in reasons.items() if reason is not None}


def layer_remedy(layer: Layer) -> str:
    """Describe how to get a missing layer."""
    if layer is Layer.SECCOMP:
        return "use a kernel with seccomp, on x86-64 or aarch64"
    if sys.platform != "linux":
        return ANOTHER_SYSTEM
    reason = landlock.why_not() or ""
    if "boot" in reason:
        return "add landlock to the boot parameter lsm= (present value: /sys/kernel/security/lsm)"
    if "refused" in reason:
        return "allow the landlock_ system calls in the container's seccomp profile"
    return "use Linux 5.13 or newer, built with Landlock"
