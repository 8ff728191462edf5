"""Printed figures of controllers against executions of the exported files, independent of ASIA's
simulation: 30 designs, PID, state feedback and predictive, of plants with and without dead time and
feedthrough, with operating points and limits.

Run: python benchmarks/control/printed_executed.py [COUNT]
"""

import json
import math
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from scipy.signal import cont2discrete

PLANTS = [
    ("1.3/(s+12.7)", (1.0, 12.7), 0.0),
    ("2/(5*s+1)", (5.0, 1.0), 0.0),
    ("2/(s^2+1.2*s+1)", (1.0, 1.2, 1.0), 0.0),
    ("1/(s+1)^3", (1.0, 3.0, 3.0, 1.0), 0.0),
    ("2/(5*s+1)", (5.0, 1.0), 1.0),
    ("(s+2)/(s+1)", (1.0, 1.0), 0.0),
    ("(0.001*s+2)/(s+1)", (1.0, 1.0), 0.0),
    ("(1-0.3*s)/(s+1)^2", (1.0, 2.0, 1.0), 0.0),
    ("1/(s*(s+1))", (1.0, 1.0, 0.0), 0.0),
    ("5/(s-1)", (1.0, -1.0), 0.0),
]
NUMERATORS = [(1.3,), (2.0,), (2.0,), (1.0,), (2.0,), (1.0, 2.0), (0.001, 2.0), (-0.3, 1.0), (1.0,),
              (5.0,)]  # fmt: skip
FIGURES = ("rise", "settling", "overshoot", "error", "iae", "ise", "itae", "effort", "limited")


def executed(
    code: str, facts: dict[str, Any], num: Any, den: Any, delay: float
) -> dict[str, float]:
    """Figures of the loop of a controller file and a plant, sampled by SciPy."""
    names: dict[str, Any] = {}
    exec(code, names)
    controller, step = names["Controller"](), facts["sampling_time"]
    a, b, c, d = _sampled(num, den, step)
    late = round(delay / step)
    if abs(late * step - delay) > 1e-9 * step:
        raise ValueError("the dead time is no whole number of samples")
    limits = facts["controller"]
    low = -math.inf if limits["low"] is None else limits["low"]
    high = math.inf if limits["high"] is None else limits["high"]
    count, x = facts["samples"], np.zeros(len(a))
    held, u, y = [0.0] * (late + 1), np.zeros(count), np.zeros(count)
    for k in range(count):
        u[k] = controller.step(1.0, float(c @ x + d * held[0]))
        held = [*held[1:], u[k]]
        y[k] = c @ x + d * held[0]
        x = a @ x + b * held[0]
    error = 1.0 - y
    reach = [np.flatnonzero(y >= share) for share in (0.1, 0.9)]
    outside = np.flatnonzero(np.abs(error) > 0.02)
    settled = 0 if not len(outside) else int(outside[-1]) + 1
    size, t = np.abs(error), step * np.arange(count)
    at = np.minimum(u - low, high - u) <= 1e-9 * (1.0 + np.abs(u))
    return {
        "rise": step * float(reach[1][0] - reach[0][0]) if len(reach[1]) else math.inf,
        "settling": step * settled if settled < count else math.inf,
        "overshoot": 100.0 * max(float(y.max()) - 1.0, 0.0), "error": float(size[-1]),
        "iae": step * float(size.sum()), "ise": step * float((error**2).sum()),
        "itae": step * float((t * size).sum()),
        "effort": float(np.abs(np.diff(u, prepend=0.0)).sum()), "limited": float(at.mean()),
    }  # fmt: skip


def _sampled(num: Any, den: Any, step: float) -> tuple[Any, Any, Any, float]:
    from scipy.signal import tf2ss

    a, b, c, d, _ = cont2discrete(tf2ss(num, den), step, "zoh")
    return a, b[:, 0], c[0], float(d[0, 0])


def main() -> None:
    """Print the largest difference of each design, and of all."""
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 30
    worst, done = 0.0, 0
    for kind in ("pid", "lqr", "mpc"):
        for (text, den, delay), num in zip(PLANTS, NUMERATORS, strict=True):
            if done == count:
                break
            with tempfile.TemporaryDirectory() as made:
                words = ["control", "--plant", text, "--kind", kind, "--out", made, "--json"]
                words += ["--delay", str(delay), "--sampling-time", "0.05"]
                if "s-1" in text or "s*(" in text:
                    words += ["--settling", "8"]
                run = subprocess.run(
                    [sys.executable, "-m", "asia", *words],
                    capture_output=True,
                    text=True,
                    check=False,
                )
                if not run.stdout:
                    print(f"{kind} {text}: {run.stderr.strip()[-120:]}")
                    continue
                facts = json.loads(run.stdout)
                code = (Path(made) / "controller.py").read_text("utf-8")
                known = executed(code, facts, num, den, delay)
            printed = facts["responses"][0]
            gap = 0.0
            for name in FIGURES:
                one = math.inf if printed[name] is None else printed[name]
                if one != known[name]:
                    gap = max(gap, abs(one - known[name]) / max(1.0, abs(one)))
            worst, done = max(worst, gap), done + 1
            print(f"{kind} {text}, dead time {delay:g} s: {gap:.1e}", flush=True)
    print(f"{done} controllers, largest difference {worst:.1e}")


if __name__ == "__main__":
    main()
