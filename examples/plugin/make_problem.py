"""Write a small problem with records in text tables: python make_problem.py FOLDER."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

PROBLEM = """name = "oven"
sampling_time = 10.0
inputs = [{ name = "power", unit = "kW" }]
outputs = [{ name = "temperature", unit = "K" }]

[data]
source = "tables:records"

[protocol]
past_inputs = 5
past_outputs = 5
metric = "p95"
[protocol.test]
metrics = ["rmse", "p95"]

[budget]
experiments = 5
"""


def main(folder: Path) -> None:
    """An oven with two time constants, heated by a random staircase."""
    random = np.random.default_rng(1)
    for subset, count in (("train", 2), ("test", 1)):
        (folder / "records" / subset).mkdir(parents=True, exist_ok=True)
        for number in range(count):
            power = np.repeat(random.uniform(0.0, 3.0, 30), 20)
            wall, inside, rows = 0.0, 0.0, []
            for value in power:
                rows.append((value, inside + 0.05 * random.standard_normal()))
                wall += 0.12 * (20.0 * value - wall)
                inside += 0.2 * (wall - inside)
            np.savetxt(
                folder / "records" / subset / f"day{number + 1}.dat",
                rows,
                fmt="%.6f",
                header="power temperature",
                comments="",
            )
    (folder / "problem.toml").write_text(PROBLEM)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
