"""Time per training epoch of LTC, GRU and LSTM: ours against PyTorch.

Run `python benchmarks/models/recurrent.py`. An epoch is one update by Adam, gradient clipped, on a
record of 510 samples with 64 units, float32, one thread. PyTorch runs the same network from the
same parameters twice where it can: as an eager loop over the samples, and with `torch.nn.GRU` and
`torch.nn.LSTM`, whose loops are compiled. Losses are compared first. Prints medians, ratios and the
machine; exits with 1 when a ratio to the eager loop is below 20. Without PyTorch (extra `torch`)
only ours is timed.
"""

from __future__ import annotations

import os

os.environ.setdefault(
    "XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
)

import argparse
import importlib.util
import platform
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from asia.candidate import Context
from asia.data import Signal, Trajectory
from asia.models import ltc, recurrent
from asia.models._networks.network import NetworkModel, as_built, train_network
from asia.models._networks.structure import rollout
from asia.models.methods import Adam

SAMPLES, HIDDEN, PAST = 510, 64, 5
WANTED = 20.0
FAMILIES = ("ltc", "gru", "lstm")
CONTEXT = Context((Signal("u"),), (Signal("y"),), 1.0, PAST, PAST)
Step = Callable[[], float]


def network(family: str) -> NetworkModel:
    """An untrained network of the family with a random output layer."""
    if family == "ltc":
        return ltc.build(ltc.Config(hidden=HIDDEN, start="uniform"), CONTEXT)
    config = recurrent.Config("gru" if family == "gru" else "lstm", HIDDEN, start="uniform")
    return recurrent.build(config, CONTEXT)


def signals() -> tuple[Any, Any]:
    """u and y (T + past, 1), white and of variance one."""
    rng = np.random.default_rng(0)
    values = rng.standard_normal((2, SAMPLES + PAST, 1))
    values -= values.mean(axis=1, keepdims=True)
    u, y = values / values.std(axis=1, keepdims=True)
    return u, y


def ours(family: str, updates: int) -> float:
    """Seconds an update, the median over stretches of the compiled loop after its first."""
    u, y = signals()
    at: list[float] = []
    context = replace(CONTEXT, log=lambda step, loss: at.append(time.perf_counter()))
    method = Adam(updates, 1e-3, schedule="constant")
    train_network(network(family), [Trajectory(u, y, 1.0)], context, method, as_built)
    return statistics.median(np.diff(at).tolist()) / (updates / len(at))


def our_loss(family: str) -> float:
    """Mean squared error before the first update."""
    model, (u, y) = network(family), signals()
    window = np.concatenate([u[:PAST, 0], y[:PAST, 0]])[None].astype(np.float32)
    outputs = rollout(model.cell, model.params, window, u[None, PAST:].astype(np.float32))
    return float(((np.asarray(outputs)[0] - y[PAST:]) ** 2).mean())


def theirs(family: str, compiled: bool) -> Step:
    """One update in PyTorch, which returns the loss before it; `compiled`: with `torch.nn`."""
    import torch

    params = network(family).params
    u, y = (torch.tensor(v, dtype=torch.float32) for v in signals())
    window = torch.cat([u[:PAST, 0], y[:PAST, 0]])[None]
    inputs, target = u[None, PAST:], y[None, PAST:]
    flat = {k: v for k, v in params.items() if k != "layers"}
    flat |= {f"layer_{k}": v for layer in params.get("layers", ()) for k, v in layer.items()}
    p = {k: torch.tensor(v, requires_grad=True) for k, v in flat.items()}
    run = library(family, p) if compiled else LOOPS[family]
    extra = list(run.parameters()) if compiled else []
    leaves = [*p.values(), *extra]
    optimiser = torch.optim.AdamW(leaves, 1e-3, weight_decay=1e-4)

    def step() -> float:
        optimiser.zero_grad()
        start = torch.tanh(window @ p["enc_w1"] + p["enc_b1"]) @ p["enc_w2"] + p["enc_b2"]
        features = torch.cat([run(torch, p, torch.tanh(start), inputs), inputs], 2)
        loss = ((features @ p["out_w"] + p["out_b"] - target) ** 2).mean()
        loss.backward()
        torch.nn.utils.clip_grad_norm_([v for v in leaves if v.grad is not None], 1.0)
        optimiser.step()
        return float(loss.detach())

    return step


def ltc_loop(torch: Any, p: Any, h: Any, inputs: Any) -> Any:
    decay = torch.exp(-torch.exp(-p["log_tau"]))
    f_in, states = torch.cat([p["f_h"], p["f_u"]]), []
    for k in range(SAMPLES):
        inner = torch.tanh(torch.cat([h, inputs[:, k]], 1) @ f_in + p["f_b1"])
        h = decay * h + (1 - decay) * torch.tanh(inner @ p["f_w2"] + p["f_b2"])
        states.append(h)
    return torch.stack(states, 1)


def gru_loop(torch: Any, p: Any, start: Any, inputs: Any) -> Any:
    h, states = start[:, :HIDDEN], []
    drive = inputs @ p["layer_u"] + p["layer_b"]
    for k in range(SAMPLES):
        r, z, n = drive[:, k].chunk(3, 1)
        back_r, back_z, back_n = (h @ p["layer_h"]).chunk(3, 1)
        reset, keep = torch.sigmoid(r + back_r), torch.sigmoid(z + back_z)
        h = keep * h + (1 - keep) * torch.tanh(n + reset * back_n)
        states.append(h)
    return torch.stack(states, 1)


def lstm_loop(torch: Any, p: Any, start: Any, inputs: Any) -> Any:
    (h, c), states = start.chunk(2, 1), []
    drive = inputs @ p["layer_u"] + p["layer_b"]
    for k in range(SAMPLES):
        write, keep, read, new = (drive[:, k] + h @ p["layer_h"]).chunk(4, 1)
        c = torch.sigmoid(keep) * c + torch.sigmoid(write) * torch.tanh(new)
        h = torch.sigmoid(read) * torch.tanh(c)
        states.append(h)
    return torch.stack(states, 1)


LOOPS: dict[str, Any] = {"ltc": ltc_loop, "gru": gru_loop, "lstm": lstm_loop}


def library(family: str, p: Any) -> Any:
    """`torch.nn.GRU` or `torch.nn.LSTM` with the parameters of `p`, which it takes out of it."""
    import torch

    inner = (torch.nn.GRU if family == "gru" else torch.nn.LSTM)(1, HIDDEN, batch_first=True)
    # PyTorch's order of the LSTM's gates is write, keep, new, read.
    order = [0, 1, 2] if family == "gru" else [0, 1, 3, 2]
    values = [p.pop(f"layer_{name}").detach() for name in ("u", "h", "b")]
    w_u, w_h, bias = (torch.cat([v.chunk(len(order), -1)[i] for i in order], -1) for v in values)
    with torch.no_grad():
        inner.weight_ih_l0.copy_(w_u.T)
        inner.weight_hh_l0.copy_(w_h.T)
        inner.bias_ih_l0.copy_(bias)
        inner.bias_hh_l0.zero_()

    class Run(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.inner = inner

        def forward(self, torch: Any, p: Any, start: Any, inputs: Any) -> Any:
            del torch, p
            h, c = (v[None].contiguous() for v in start.chunk(2, 1))
            return self.inner(inputs, h if family == "gru" else (h, c))[0]

    return Run()


def median_time(step: Step, repeats: int) -> float:
    """Seconds; the first call is not counted."""
    step()
    times: list[float] = []
    for _ in range(repeats):
        start = time.perf_counter()
        step()
        times.append(time.perf_counter() - start)
    return statistics.median(times)


def machine() -> str:
    """Processor, cores, load and libraries."""
    import jax

    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = [line.split(":")[1].strip() for line in lines if line.startswith("model name")]
    name = names[0] if names else platform.processor() or platform.machine()
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else float("nan")
    return f"{name}, {os.cpu_count()} cores, load {load:.1f}, jax {jax.__version__}"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=30, help="updates of PyTorch to time")
    parser.add_argument("--updates", type=int, default=500, help="updates of ours")
    options = parser.parse_args()
    torch = None
    if importlib.util.find_spec("torch") is None:
        print("PyTorch is missing: pip install torch to compare")
    else:
        import torch

        torch.set_num_threads(1)
    version = "" if torch is None else f", torch {torch.__version__}"
    print(f"{machine()}{version}\n")
    print("| network | ours, ms | eager loop, ms | ratio | torch.nn, ms | ratio |")
    print("|---|---|---|---|---|---|")
    enough = True
    for family in FAMILIES:
        fast = ours(family, options.updates)
        cells = [family.upper(), f"{1e3 * fast:.2f}"]
        for compiled in (False, True):
            if torch is None or (compiled and family == "ltc"):
                cells += ["-", "-"]
                continue
            step = theirs(family, compiled)
            np.testing.assert_allclose(step(), our_loss(family), rtol=1e-4)
            slow = median_time(step, options.repeats)
            cells += [f"{1e3 * slow:.2f}", f"{slow / fast:.1f}"]
            enough = enough and (compiled or slow >= WANTED * fast)
        print(f"| {' | '.join(cells)} |", flush=True)
    return 0 if enough else 1


if __name__ == "__main__":
    sys.exit(main())
