"""Controllers for the tasks of ControlEval, judged by python-control: share that pass, seconds.

One design a task, no language model. The judge uses `control.margin` and `control.step_info` of the
unity-feedback loop, with Pade's approximation of order 5 for a dead time.

    python benchmarks/control/controleval.py --tasks DATA/controleval
"""

from __future__ import annotations

import argparse
import json
import time
import warnings
from collections import Counter
from multiprocessing import Pool
from pathlib import Path
from statistics import median
from typing import Any

import control
import numpy as np

from asia.control.design import Specification, Transfer, design

warnings.simplefilter("ignore")


def judged(
    task: dict[str, Any], num: np.ndarray, den: np.ndarray, *, fine: bool = False
) -> list[str]:
    """Violated specifications by python-control; `fine`: with 20 000 points over three times the
    longest settling time instead of its own choice of times."""
    plant = control.tf(task["num"], task["den"])
    if task.get("tau"):
        plant = plant * control.tf(*control.pade(task["tau"], 5))
    loop = control.tf(num, den) * plant
    closed = control.feedback(loop, 1)
    if np.real(closed.poles()).max() >= 0:
        return ["stability"]
    gain, phase, _, _ = control.margin(loop)
    times = np.linspace(0.0, 3.0 * task["settling_time_max"], 20_000) if fine else None
    info = control.step_info(closed, T=times, SettlingTimeThreshold=0.02)
    error = abs(1.0 - closed.dcgain())
    missed: list[str] = []
    if gain < task["gain_margin_min"]:
        missed.append("gain margin")
    if phase < task["phase_margin_min"]:
        missed.append("phase margin")
    if not task["settling_time_min"] <= info["SettlingTime"] <= task["settling_time_max"]:
        missed.append("settling time")
    if info["Overshoot"] > task["overshoot_max"]:
        missed.append("overshoot")
    if error > task["steadystate_error_max"]:
        missed.append("steady-state error")
    return missed


def solve(task: dict[str, Any]) -> tuple[str, list[str], tuple[str, ...], float, str, list[str]]:
    """Kind of task, missed specifications, those that the design names, processor seconds,
    structure, missed with a fine grid of times."""
    begin = time.process_time()
    plant = Transfer(np.array(task["num"], float), np.array(task["den"], float), task.get("tau", 0))
    wanted = Specification(
        task["gain_margin_min"], task["phase_margin_min"], task["settling_time_min"],
        task["settling_time_max"], task["overshoot_max"], task["steadystate_error_max"],
    )  # fmt: skip
    found = design([plant], wanted)
    took = time.process_time() - begin
    parts = found.controller.num, found.controller.den
    missed, fine = judged(task, *parts), judged(task, *parts, fine=True)
    if missed or fine:
        print(task["kind"], task["id"], missed, fine, found.violated, found.structure, flush=True)
    return task["kind"], missed, found.violated, took, found.structure, fine


def main() -> None:
    """Print a table by kind of task."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--tasks", type=Path, required=True)
    parser.add_argument("--every", type=int, default=1)
    parser.add_argument("--kinds", nargs="+", help="parts of the names of the files")
    parser.add_argument("--processes", type=int, default=2)
    given = parser.parse_args()
    tasks = [
        {**task, "kind": path.stem.removesuffix("_data")}
        for path in sorted(given.tasks.glob("*.json"))
        if not given.kinds or any(kind in path.stem for kind in given.kinds)
        for task in json.loads(path.read_text("utf-8"))[:: given.every]
    ]
    with Pool(given.processes) as pool:
        results = pool.map(solve, tasks, chunksize=1)
    print("| kind | pass | tasks | seconds, median | structures | missed by the judge |")
    print("|---|---|---|---|---|---|")
    for kind in dict.fromkeys(task["kind"] for task in tasks):
        rows = [row for row in results if row[0] == kind]
        used = Counter(row[4] for row in rows)
        missed = Counter(name for row in rows for name in row[1])
        print(
            f"| {kind} | {sum(not row[1] for row in rows)} | {len(rows)} "
            f"| {median(row[3] for row in rows):.2f} "
            f"| {', '.join(f'{n} {c}' for n, c in used.most_common())} "
            f"| {', '.join(f'{n} {c}' for n, c in missed.most_common()) or '-'} |"
        )
    passed = sum(not row[1] for row in results)
    named = sum(bool(row[1]) and bool(row[2]) for row in results)
    fine = sum(not row[5] for row in results)
    print(f"\n{fine} pass with a fine grid of times")
    print(f"{passed} of {len(results)} pass ({passed / len(results):.1%}); of the others the "
          f"design itself names a missed specification in {named}")  # fmt: skip


if __name__ == "__main__":
    main()
