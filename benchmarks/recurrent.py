"""Gradient of a 64-unit LTC network over 510 samples: ours against an eager PyTorch loop.

Run `python benchmarks/recurrent.py`. Both compute the same loss from the same float32 parameters
(the two losses and gradients are compared first), on one thread, with one record. Prints the
median time of a forward and backward pass of each and their ratio; exits with 1 when ours is less
than 20 times faster. Without PyTorch (extra `torch`) only ours is timed.
"""

from __future__ import annotations

import os

os.environ.setdefault(
    "XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
)

import argparse
import importlib.util
import statistics
import sys
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from asia.candidate import Context
from asia.models import ltc
from asia.models._network import rollout
from asia.problem import Signal

SAMPLES, HIDDEN, PAST = 510, 64, 5
WANTED = 20.0


def problem() -> tuple[Any, dict[str, Any], Any, Any, Any]:
    """Cell, float32 parameters with a random output layer, window (1, d), u and y (1, T, 1)."""
    context = Context((Signal("u"),), (Signal("y"),), 1.0, PAST, PAST)
    model = ltc.build(ltc.Config(hidden=HIDDEN), context)
    rng = np.random.default_rng(0)
    out_w = 0.1 * rng.standard_normal((HIDDEN + 1, 1)).astype(np.float32)
    window, u, y = (
        rng.standard_normal(shape).astype(np.float32)
        for shape in ((1, 2 * PAST), (1, SAMPLES, 1), (1, SAMPLES, 1))
    )
    return model.cell, {**model.params, "out_w": out_w}, window, u, y


def median_time(call: Callable[[], Any], repeats: int) -> float:
    """Seconds; the first call, which compiles, is not counted."""
    call()
    times: list[float] = []
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return statistics.median(times)


def ours() -> tuple[Callable[[], Any], float, dict[str, Any]]:
    """A call that computes the gradient, the loss and the gradient itself."""
    cell, params, window, u, y = problem()

    def loss(p: Any) -> jax.Array:
        return jnp.mean((rollout(cell, p, window, u) - y) ** 2)

    gradient = jax.jit(jax.value_and_grad(loss))
    value, slopes = gradient(params)
    return lambda: jax.block_until_ready(gradient(params)), float(value), dict(slopes)


def theirs() -> tuple[Callable[[], Any], float, dict[str, Any]]:
    """The same in PyTorch, stepping through the samples in Python."""
    import torch

    torch.set_num_threads(1)
    _, params, window, u, y = problem()
    p = {k: torch.tensor(v, requires_grad=True) for k, v in params.items()}
    start, inputs, target = (torch.tensor(v) for v in (window, u, y))

    def forward_backward() -> Any:
        for v in p.values():
            v.grad = None
        h = torch.tanh(torch.tanh(start @ p["enc_w1"] + p["enc_b1"]) @ p["enc_w2"] + p["enc_b2"])
        decay = torch.exp(-torch.exp(-p["log_tau"]))
        f_in = torch.cat([p["f_h"], p["f_u"]])
        states = []
        for k in range(SAMPLES):
            inner = torch.tanh(torch.cat([h, inputs[:, k]], 1) @ f_in + p["f_b1"])
            h = decay * h + (1 - decay) * torch.tanh(inner @ p["f_w2"] + p["f_b2"])
            states.append(h)
        features = torch.cat([torch.stack(states, 1), inputs], 2)
        loss = ((features @ p["out_w"] + p["out_b"] - target) ** 2).mean()
        loss.backward()
        return loss

    value = float(forward_backward().detach())
    return forward_backward, value, {k: v.grad.numpy().copy() for k, v in p.items()}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=30)
    repeats = parser.parse_args().repeats
    call, value, slopes = ours()
    fast = median_time(call, repeats)
    print(f"asia.models.ltc (JAX)   {1e3 * fast:8.2f} ms  forward and backward, median")
    if importlib.util.find_spec("torch") is None:
        print("PyTorch is missing: pip install 'asia-sysid[torch]' to compare")
        return 0
    call, other_value, other_slopes = theirs()
    slow = median_time(call, repeats)
    print(f"PyTorch eager loop      {1e3 * slow:8.2f} ms")
    np.testing.assert_allclose(value, other_value, rtol=1e-4)
    for name, slope in slopes.items():
        np.testing.assert_allclose(slope, other_slopes[name], rtol=1e-2, atol=1e-4)
    print(f"ratio                   {slow / fast:8.1f}     (at least {WANTED:.0f} wanted)")
    return 0 if slow >= WANTED * fast else 1


if __name__ == "__main__":
    sys.exit(main())
