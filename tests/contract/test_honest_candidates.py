"""Five honest candidates, written by hand: each is scored, and no check objects."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from asia.candidate import Context
from asia.data import Signal, Trajectory
from asia.judge.evaluation.evaluator import EvaluationData, Evaluator, EvaluatorOptions
from asia.judge.evaluation.workers import WorkerRunner
from asia.judge.executors import LocalExecutor
from asia.judge.sandbox.availability import probe
from asia.judge.scoring.outcome import Score
from asia.problem import Budget
from asia.problem.folds import make_folds
from asia.problem.protocol import ProtocolRule

FOLDER = Path(__file__).parent / "honest"
SAMPLES = 300
# Sampling time, and the largest V of a model that has been fitted at all. A chaotic one leaves its
# record, as any does.
FITTED = {
    "chaotic_oscillator": (0.1, 3.0),
    "delay_line": (0.5, 0.3),
    "ensemble": (0.5, 0.3),
    "event_relay": (0.5, 1.6),
    "hysteresis": (0.5, 0.4),
}


def record(name: str, dt: float) -> Trajectory:
    """A noisy record of the system that the candidate models, or of a leaking tank."""
    random = np.random.default_rng(11)
    u = np.repeat(random.uniform(0.5, 1.5, size=SAMPLES // 5), 5)
    y, fine = np.empty(SAMPLES), 50
    x, speed, play, on, line = 1.0, 0.0, u[0], 1.0, [u[0]] * 6
    if name == "chaotic_oscillator":
        u = 7.5 * np.cos(dt * np.arange(SAMPLES)) + 0.2 * (u - 1)
    for k in range(SAMPLES):
        y[k] = x
        line = [*line[1:], u[k]]
        play = min(max(play, u[k] - 0.2), u[k] + 0.2)
        for _ in range(fine):
            h = dt / fine
            if name == "chaotic_oscillator":
                x, speed = x + h * speed, speed + h * (u[k] - 0.05 * speed - x**3)
            elif name == "event_relay":
                on = 0.0 if x > 2.6 else 1.0 if x < 2.2 else on
                x += h * 0.4 * (u[k] - x + 3.0 * on)
            elif name == "hysteresis":
                x += h * (play - x)
            elif name == "delay_line":
                x += h * (line[0] - x)
            else:
                x += h * (-0.5 * np.sqrt(max(x, 0.0)) + 0.5 * u[k])
    return Trajectory(u, y + 0.003 * random.normal(size=SAMPLES), dt, name)


@pytest.mark.slow
@pytest.mark.parametrize(
    "windows",
    [
        pytest.param(False, id="simulation"),
        pytest.param(True, id="windows", marks=pytest.mark.long),
    ],
)
@pytest.mark.parametrize("name", FITTED)
def test_an_honest_candidate_is_scored_without_an_alarm(name: str, windows: bool) -> None:
    dt, most = FITTED[name]
    horizon = 40 if windows else None
    rule = ProtocolRule("windows" if windows else "simulation", horizon=horizon)
    context = Context((Signal("u"),), (Signal("y"),), dt, 10, 10, horizon, seed=3)
    records = (record(name, dt),)
    data = EvaluationData(make_folds(records, rule), records, context, rule)
    workers = WorkerRunner(probe().level, Budget(fit_seconds=120.0), LocalExecutor(2))
    evaluator = Evaluator(data, workers, EvaluatorOptions("salt"))
    source = (FOLDER / f"{name}.py").read_text("utf-8")
    found = evaluator.evaluate(source)
    assert isinstance(found.outcome, Score), found.outcome
    assert found.outcome.value < most
    assert evaluator.objection(source, found) is None


def test_every_candidate_has_a_file() -> None:
    assert sorted(FITTED) == sorted(path.stem for path in FOLDER.glob("*.py"))
