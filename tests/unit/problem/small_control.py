"""A small control problem: a first-order plant with a load, in a folder of its own."""

from pathlib import Path

import numpy as np

PLANT = '''"""First-order lag with a load; the gain differs between scenarios."""


def step(x, u, params, dt):
    if x is None:
        return params["gain"] * 1.0, [params["gain"] * 1.0]
    x = x + 0.1 * (params["gain"] * u[0] + u[1] - x)
    return x, [x]
'''
PROBLEM = """\
name = "lag"
sampling_time = 1.0
inputs = ["u"]
outputs = ["y"]
[data]
train = ["open.csv"]
[protocol]
kind = "control"
[budget]
experiments = 2
fit_seconds = 60
retests = 0
[plant]
source = "plant.py:step"
[plant.parameters]
gain = { min = 1.9, max = 2.1 }
[control.actuators]
u = { min = 0.0, max = 3.0, start = 1.0, rate = 1.0 }
[control.setpoints]
y = { min = 1.0, max = 4.0, hold = 20.0 }
[control.disturbances]
load = { min = -0.1, max = 0.1, hold = 30.0 }
[control.noise]
y = 0.01
[control.tolerance]
y = 0.2
[control.scenarios]
samples = 60
train = 2
folds = 2
test = 1
"""
PI = '''"""PI controller."""


class Controller:
    def __init__(self, k):
        self.integral, self.k = 1.0, k

    def step(self, r, y):
        error = r[0] - y[0]
        self.integral = min(max(self.integral + 0.1 * self.k * error, 0.0), 3.0)
        return self.integral + self.k * error

    def parameters(self):
        return {"gain": self.k}


def design(models, context):
    return Controller(1.0)
'''


def write_control_problem(folder: Path, text: str = PROBLEM, plant: str = PLANT) -> Path:
    """Write the problem with an open-loop record."""
    folder.mkdir(parents=True, exist_ok=True)
    random = np.random.default_rng(0)
    u = np.repeat(random.uniform(0.5, 2.0, 30), 10)
    x, rows = 2.0, ["time,u,y"]
    for k, value in enumerate(u):
        rows.append(f"{k},{value:.6f},{x + 0.01 * random.standard_normal():.6f}")
        x += 0.1 * (2.0 * value - x)
    (folder / "open.csv").write_text("\n".join(rows) + "\n", "utf-8")
    (folder / "problem.toml").write_text(text, "utf-8")
    (folder / "plant.py").write_text(plant, "utf-8")
    (folder / "baseline.py").write_text(PI, "utf-8")
    return folder
