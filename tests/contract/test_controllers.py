"""Contract of a controller, and what a candidate cannot do in closed loop."""

import os
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from asia.errors import Reason, UserError
from asia.judge.evaluation.control import closed_loop, prepare_control
from asia.judge.evaluation.evaluator import EvaluationData, Evaluator
from asia.judge.evaluation.fold_fits import search_context
from asia.judge.evaluation.workers import WorkerRunner
from asia.judge.executors import LocalExecutor
from asia.judge.sandbox.availability import probe
from asia.judge.sandbox.types import Isolation
from asia.judge.scoring.outcome import Failure, Score
from asia.ledger.simulated import fold_outputs
from asia.problem.folds import make_folds
from asia.problem.load import load_problem
from asia.problem.problem import Problem
from tests.unit.problem.small_control import PI, PLANT, write_control_problem


def evaluator_of(problem: Problem) -> Evaluator:
    workers = WorkerRunner(probe().level, problem.budget, LocalExecutor(2))
    workers.closed_loop = closed_loop(problem, partial(workers.open_for, fitting=True, plant=True))
    folds = make_folds(problem.train, problem.protocol)
    context = search_context(problem, 1)
    return Evaluator(EvaluationData(folds, problem.train, context, problem.protocol), workers)


@pytest.fixture(scope="module")
def problem(tmp_path_factory: pytest.TempPathFactory) -> Problem:
    return load_problem(write_control_problem(tmp_path_factory.mktemp("lag")))


@pytest.fixture(scope="module")
def evaluator(problem: Problem) -> Evaluator:
    return evaluator_of(problem)


def expected_responses(problem: Problem, gain: float = 1.0) -> list[np.ndarray]:
    """The loop of `PI` and `PLANT`, computed here, for each training scenario."""
    found: list[np.ndarray] = []
    for record in problem.train:
        k = record.u[0, 3]
        x, u, integral, rows = k * 1.0, 1.0, 1.0, list[tuple[float, float]]()
        for r, load, noise, _ in record.u:
            error = r - (x + noise)
            integral = min(max(integral + 0.1 * gain * error, 0.0), 3.0)
            wanted, before = integral + gain * error, u
            u = min(max(min(max(wanted, 0.0), 3.0), before - 1.0), before + 1.0)
            x = x + 0.1 * (k * u + load - x)
            rows.append((x, u - before))
        found.append(np.array(rows))
    return found


def test_the_loop_is_that_of_plant_and_controller(problem: Problem, evaluator: Evaluator) -> None:
    found = evaluator.evaluate(PI)
    assert isinstance(found.outcome, Score)
    expected = expected_responses(problem)
    simulated = fold_outputs(found.artifacts, found.folds, evaluator.data.folds)
    for fold, each, record in zip(evaluator.data.folds, simulated, found.folds, strict=True):
        for block, y_hat in zip(fold.held_out, each, strict=True):
            assert np.allclose(y_hat, expected[block.record], rtol=0, atol=1e-12)
        assert dict(record.parameters) == {"gain": 1.0}
    # V: RMSE over the tolerance, mean over the signals, then over the folds.
    parts = [
        np.mean(
            [
                np.sqrt(np.mean((expected[b.record][:, c] - b.y[:, c]) ** 2)) / fold.scale[c]
                for c in range(2)
            ]
        )
        for fold in evaluator.data.folds
        for b in fold.held_out
    ]
    assert found.outcome.value == pytest.approx(np.mean(parts))
    assert evaluator.objection(PI, found) is None


def test_every_scenario_begins_with_a_fresh_controller(evaluator: Evaluator) -> None:
    first = evaluator.evaluate(PI)
    folds = evaluator.data.folds
    model = first.artifacts.get(first.folds[0].model)
    again = evaluator.models.simulate(PI, [model], [b for f in folds for b in f.held_out])
    y_hat = fold_outputs(first.artifacts, first.folds, folds)[0]
    assert np.array_equal(again[0][0], y_hat[0])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        ("return self.integral + self.k * error", "return float('nan')", Reason.NOT_FINITE),
        ("return self.integral + self.k * error", "return [1.0, 1.0]", Reason.WRONG_LENGTH),
        ("return self.integral + self.k * error", "return 'full'", Reason.CONTRACT),
        ("return self.integral + self.k * error", "raise ValueError", Reason.CRASH),
        ("return Controller(1.0)", "return 1.0", Reason.CRASH),
        ("def design(models", "def fit(models", Reason.CONTRACT),
    ],
)
def test_what_breaks_the_contract(evaluator: Evaluator, old: str, new: str, reason: Reason) -> None:
    assert old in PI
    outcome = evaluator.evaluate(PI.replace(old, new)).outcome
    assert isinstance(outcome, Failure)
    assert outcome.reason is reason


def test_inputs_beyond_the_limits_are_clipped(problem: Problem, evaluator: Evaluator) -> None:
    source = PI.replace("return self.integral + self.k * error", "return 1e9")
    found = evaluator.evaluate(source)
    assert isinstance(found.outcome, Score)
    for each in fold_outputs(found.artifacts, found.folds, evaluator.data.folds):
        for y_hat in each:
            u = 1.0 + np.cumsum(y_hat[:, 1])
            # One unit a second, and the upper limit.
            assert u[:3].tolist() == [2.0, 3.0, 3.0]
            assert u.max() == 3.0


# A candidate that looks around. It moves the input once it has found something, so that the
# response tells.
_LOOKING = '''"""Look for {what} in the process and its files."""

import gc
import os
import sys

import numpy as np


class Controller:
    def __init__(self, known):
        self.known = known

    def found(self, r):
{look}
        return False

    def step(self, r, y):
        return 3.0 if self.found(r) else 1.0


def design(models, context):
    known = [t.u.copy() for t in context.control.scenarios]
    return Controller(known)
'''
_FUTURE = """\
        held = [f.f_locals for f in frames(sys._getframe())]
        held += [o for o in gc.get_objects() if isinstance(o, (dict, list, tuple))]
        for one in held:
            for value in list(one.values() if isinstance(one, dict) else one):
                if isinstance(value, np.ndarray) and value.ndim and len(value) == 60:
                    first = value.reshape(60, -1)[:, 0]
                    if not any(np.isin(first, k).all() for k in self.known):
                        return True"""
_FRAMES = """

def frames(frame):
    while frame is not None:
        yield frame
        frame = frame.f_back
"""
_PLANT_FILE = """\
        for place in ({place!r}, os.path.dirname({place!r})):
            try:
                os.listdir(place) if os.path.isdir(place) else open(place).read()
                return True
            except OSError:
                pass
        if "plant" in sys.modules:
            return True"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("what", "finds"),
    [("the future", False), ("a planted scenario", True), ("the plant", False), ("a file", True)],
)
def test_a_controller_finds_neither_future_nor_plant(
    problem: Problem, evaluator: Evaluator, what: str, finds: bool
) -> None:
    """The same search finds what is there: an array of a scenario's length, and an open file."""
    if probe().level is Isolation.PROCESS:
        pytest.skip("files are open at level process")
    assert problem.control is not None
    place = problem.control.plant.source.rpartition(":")[0]
    assert Path(place).is_file()
    look = _PLANT_FILE.format(place=place if what == "the plant" else os.__file__)
    look = _FUTURE if what in ("the future", "a planted scenario") else look
    source = _LOOKING.format(what=what, look=look) + _FRAMES
    if what == "a planted scenario":
        source += "\nPLANTED = [np.arange(60.0)]\n"
    found = evaluator.evaluate(source)
    assert isinstance(found.outcome, Score), found.outcome
    for each in fold_outputs(found.artifacts, found.folds, evaluator.data.folds):
        for y_hat in each:
            assert bool(y_hat[:, 1].any()) == finds


def test_a_controller_cannot_carry_state_between_scenarios(evaluator: Evaluator) -> None:
    # A global survives the copies: cases in another order are answered otherwise.
    source = PI.replace("class Controller", "CALLS = [0]\n\n\nclass Controller").replace(
        "return self.integral + self.k * error",
        "CALLS[0] += 1\n        return self.integral + self.k * error + 1e-3 * CALLS[0]",
    )
    found = evaluator.evaluate(source)
    assert isinstance(found.outcome, Score)
    failure = evaluator.objection(source, found)
    assert failure is not None


def test_a_plant_that_fails_is_named_before_the_search(tmp_path: Path) -> None:
    level = probe().level
    broken = PLANT.replace('params["gain"] * u[0]', 'params["gian"] * u[0]')
    problem = load_problem(write_control_problem(tmp_path / "broken", plant=broken))
    with pytest.raises(UserError, match=r"\[plant\] plant.py:step failed"):
        prepare_control(problem, level)
    wild = PLANT.replace("0.1 * (params", "1e200 * x * x + 0.1 * (params")
    problem = load_problem(write_control_problem(tmp_path / "wild", plant=wild))
    with pytest.raises(UserError, match="is not finite with its inputs held"):
        prepare_control(problem, level)


@pytest.mark.slow
def test_models_are_identified_and_given_to_the_design(problem: Problem) -> None:
    prepared = prepare_control(problem, probe().level)
    assert prepared.control is not None
    assert len(prepared.control.models) > 1
    source = """
import numpy as np


class Controller:
    def __init__(self, gain):
        self.gain = gain

    def step(self, r, y):
        return r[0] / self.gain


def design(models, context):
    past = np.ones((1, context.n_past_u, 1)), np.full((1, context.n_past_y, 1), 2.0)
    y = models[0].simulate(*past, np.full((1, 200, 1), 1.5))
    return Controller(float(y[0, -1, 0]) / 1.5)
"""
    found = evaluator_of(prepared).evaluate(source)
    held = evaluator_of(prepared).evaluate(PI.replace("self.k = 1.0, k", "self.k = 1.0, 0.0"))
    assert isinstance(found.outcome, Score), found.outcome
    assert isinstance(held.outcome, Score)
    assert found.outcome.value < 0.9 * held.outcome.value
