"""Control problem of a run: plant, ranges, search, and refusals."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest

import asia
from asia.control.control_problem import control_problem_of_run
from asia.errors import UserError
from asia.export.linear import linearize
from asia.judge.evaluation import references
from asia.judge.scoring.outcome import Score
from asia.problem.load import load_problem
from tests.unit.interfaces.cli.conftest import command_line
from tests.unit.search.toy import Scripted

# y[k] by two samples before: no input acts on the output of its own sample.
EQUATION = """import jax.numpy as jnp
import numpy as np


class Model:
    def __init__(self, weights):
        self.weights = weights

    def initial(self, past_u, past_y, u):
        return jnp.concatenate([past_y[:, -1], past_y[:, -2], past_u[:, -1], past_u[:, -2]], axis=1)

    def step(self, x, u):
        y = x @ self.weights
        return jnp.concatenate([y, x[:, :1], u, x[:, 2:4]], axis=1), y

    def simulate(self, past_u, past_y, u):
        x, found = self.initial(past_u, past_y, u[:, 0]), []
        for k in range(u.shape[1]):
            x, y = self.step(x, u[:, k])
            found.append(np.asarray(y))
        return np.stack(found, axis=1)


def fit(trajectories, context):
    rows, targets = [], []
    for t in trajectories:
        rows += [np.concatenate([t.y[k - 1], t.y[k - 2], t.u[k - 1], t.u[k - 2]])
                 for k in range(2, len(t))]
        targets.append(t.y[2:])
    return Model(np.linalg.lstsq(np.array(rows), np.concatenate(targets), rcond=None)[0])
"""
PROBLEM = """\
sampling_time = 2.0
inputs = ["valve", "load"]
outputs = ["level"]
[data]
train = ["a.csv"]
[protocol]
past_inputs = 5
past_outputs = 5
folds = { kind = "contiguous", count = 2 }
[budget]
retests = 0
"""
PI = '''"""PI controller."""
import numpy as np


class Controller:
    def __init__(self, a):
        self.low, self.high, self.integral = a.min, a.max, a.start

    def step(self, r, y):
        error = r[0] - y[0]
        self.integral = min(max(self.integral + 0.05 * error, self.low), self.high)
        return np.array([self.integral + 0.3 * error])


def design(models, context):
    return Controller(context.control.actuators[0])
'''


def record(samples: int = 300) -> np.ndarray:
    """Valve, load and level: a lag whose output is measured before the input acts."""
    rng = np.random.default_rng(0)
    valve = np.repeat(rng.uniform(0.0, 3.0, samples // 10), 10)
    load = np.repeat(rng.uniform(-0.5, 0.5, samples // 20), 20)
    level, x = np.zeros(samples), np.zeros(2)
    for k in range(samples):
        level[k] = x[1]
        x = x + 0.2 * np.array([2.0 * valve[k] + load[k] - x[0], x[0] - x[1]])
    return np.column_stack([valve, load, level + 0.01 * rng.standard_normal(samples)])


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Finished run of a linear model."""
    folder = tmp_path_factory.mktemp("run")
    (folder / "lag").mkdir()
    np.savetxt(
        folder / "lag" / "a.csv", record(), delimiter=",", header="valve,load,level", comments=""
    )
    (folder / "lag" / "problem.toml").write_text(PROBLEM)
    (folder / "lag" / "baseline.py").write_text(EQUATION)
    found = asia.run(folder / "lag", agent=Scripted(()), experiments=1, runs=folder / "runs")
    return found.directory


@pytest.mark.slow
def test_the_plant_is_the_models_of_the_run(run: Path, tmp_path: Path) -> None:
    made = control_problem_of_run(tmp_path / "loop", run, ["valve"])
    control = load_problem(made.path.parent).control
    assert control is not None
    assert [s.name for s in control.outside] == [
        "level_setpoint", "load", "level_noise", "plant_model",
    ]  # fmt: skip
    assert control.plant.parameters["plant_model"].max == 3.0
    # Records without the disturbance, which no controller sees.
    (read,) = control.base.train
    assert np.array_equal(read.u[:, 0], record()[: len(read), 0])  # the rest is held back
    assert control.table.noise["level"] == pytest.approx(0.01, rel=0.3)
    steps = control.table.setpoints["level"]
    actuator = control.table.actuators["valve"]
    assert record()[:, 2].min() < steps.min < 2.0 * actuator.start < steps.max
    assert steps.max < 2.0 * actuator.max

    spec = importlib.util.spec_from_file_location("plant", made.path.parent / "plant.py")
    assert spec is not None
    assert spec.loader is not None
    plant = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(plant)
    point = linearize(run).points[0]
    u = np.random.default_rng(1).uniform(0.0, 2.0, (40, 2))
    for k, linear in enumerate((point.model, *point.folds)):
        x, y = plant.step(None, linear.u0, {"plant_model": k + 0.5}, 2.0)
        assert y == pytest.approx(linear.y0, abs=1e-6)
        state = np.zeros(linear.order)
        for sample in u:
            x, y = plant.step(x, sample, {"plant_model": k + 0.5}, 2.0)
            state = linear.a @ state + linear.b @ (sample - linear.u0)
            # At the end of the sample.
            assert y == pytest.approx(linear.c @ state + linear.y0, abs=1e-6)


@pytest.mark.long
def test_from_a_run_to_a_controller_in_two_commands(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    held = {"inputs held": references.CONTROLLERS["inputs held"]}
    monkeypatch.setattr(references, "CONTROLLERS", held)
    made = command_line("init", tmp_path / "loop", "--control", run, "--inputs", "valve")
    assert made.code == 0, made.err
    assert "setpoint level" in made.out
    found = asia.run(
        tmp_path / "loop", agent=Scripted((PI,)), experiments=2, runs=tmp_path / "runs"
    )
    (reference,) = found.view.references
    assert isinstance(reference.outcome, Score)
    assert found.view.best is not None
    assert found.view.best.score is not None
    assert found.view.best.score.value < 0.7 * reference.outcome.value


@pytest.mark.slow
def test_signals_that_make_no_control_problem_are_refused(run: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="--inputs: the run has no 'valv'; did you mean 'valve'"):
        control_problem_of_run(tmp_path / "loop", run, ["valv"])
    refused = command_line("init", tmp_path / "loop", "--control", run, "--train", "a.csv")
    assert "--control takes the records of the run" in refused.err
    assert not (tmp_path / "loop").exists()
