import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from asia.agents import Agent
from asia.errors import Reason, UserError
from asia.judge.evaluation.references import LINEAR
from asia.judge.scoring.outcome import Failure
from asia.ledger.chain import in_use
from asia.ledger.events import Evaluated, Use
from asia.ledger.run import open_run
from asia.ledger.verification import verify
from asia.ledger.view import SearchView
from asia.presentation.results import second_fit_text
from asia.problem.load import load_problem
from asia.search.agent_views import agent_view, problem_facts
from asia.search.run import prepare, search
from asia.search.simulation import simulate
from asia.search.unsealing import unseal

from .toy import CRASH, NOISE, Scripted, arx, write_problem

TWIN = arx(2).replace("import numpy as np", "import numpy as np  # lucky charm", 1)
AGENT = Scripted((arx(2), CRASH, TWIN))


@pytest.fixture
def problem(tmp_path: Path) -> Path:
    return write_problem(tmp_path / "toy")


def go(
    problem: Path, runs: Path, agent: Agent = AGENT, experiments: int | None = None
) -> SearchView:
    loaded = load_problem(problem)
    if experiments is not None:
        loaded = replace(loaded, budget=replace(loaded.budget, experiments=experiments))
    ready = prepare(loaded, agent.name, seed=0, runs=runs)
    return search(ready, agent, lambda event, view: None, lambda view: None)


@pytest.fixture(scope="module")
def whole_once(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished search of 4 experiments beside its problem, the real linear reference included."""
    root = tmp_path_factory.mktemp("whole")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("asia.judge.evaluation.references.LINEAR", LINEAR)
        go(write_problem(root / "toy", retests=2), root / "runs")
    return root


@pytest.fixture
def whole(whole_once: Path, tmp_path: Path) -> Path:
    """The run directory of a copy in tmp_path, to change at will."""
    shutil.copytree(whole_once, tmp_path, dirs_exist_ok=True)
    return tmp_path / "runs" / "toy-scripted-s0"


def outcomes(view: SearchView) -> list[tuple[object, ...]]:
    """All that must not depend on when or how often the search was run."""
    return [
        (e.number, e.proposed.source, e.result.status, e.result.outcome, e.result.folds[0].model)
        if e.result and e.result.folds
        else (e.number, e.proposed.source, e.result and e.result.status)
        for e in view.experiments
    ]


def test_a_search_end_to_end(finished: Path) -> None:
    view = open_run(finished).view
    statuses = [e.result.status for e in view.finished if e.result]
    assert statuses[:3] == ["keep", "keep", "crash"]
    assert view.stopped is not None
    assert view.stopped.reason == "budget"
    assert view.best is not None
    assert view.best.score is not None
    assert view.best.score.value < 0.05
    crash = view.experiment(3).failure
    assert crash is not None
    assert crash.reason is Reason.CRASH
    assert "no such luck" in crash.detail
    assert {r.name for r in view.references} == {
        "training mean",
        "last output held",
        "linear model",
    }
    assert view.refitted is not None
    assert view.refitted.model is not None
    assert view.refitted.again is not None
    assert view.refitted.again.value == 1.0
    verify(finished)
    assert (finished / "results.tsv").read_text().count("\n") == 5
    assert open_run(finished).state == "finished"


@pytest.mark.slow
def test_a_twin_is_answered_from_the_ledger(whole: Path) -> None:
    result = open_run(whole).view.experiment(4).result
    assert result is not None
    assert result.duplicate_of == 2
    assert result.status == "discard"


@pytest.mark.parametrize(
    "every", [pytest.param(6, marks=pytest.mark.slow), pytest.param(1, marks=pytest.mark.long)]
)
def test_resume_from_every_record_comes_to_the_same(
    whole: Path, tmp_path: Path, every: int
) -> None:
    """Before the first evaluation, so that all are made again, in the middle, and at the end."""
    directory, undisturbed = whole, open_run(whole).view
    lines = (directory / "ledger.jsonl").read_bytes().splitlines(keepends=True)
    for kept in sorted({*range(5, len(lines), every), len(lines) - 1}):
        torn = lines[kept][: len(lines[kept]) // 2]
        (directory / "ledger.jsonl").write_bytes(b"".join(lines[:kept]) + torn)
        with pytest.raises(UserError, match="not finished"):
            unseal(directory, process_consent=True)
        again = go(tmp_path / "toy", tmp_path / "runs")
        assert outcomes(again) == outcomes(undisturbed)
        evaluated = [
            line.event.experiment
            for line in open_run(directory).lines
            if isinstance(line.event, Evaluated)
        ]
        assert evaluated == [1, 2, 3, 4]
    verify(directory)
    assert unseal(directory, process_consent=True).record.refit is not None


def test_other_settings_are_refused_and_nothing_is_touched(finished: Path, tmp_path: Path) -> None:
    problem, ledger = tmp_path / "toy", finished / "ledger.jsonl"
    before = ledger.read_bytes()
    text = (problem / "problem.toml").read_text()
    (problem / "problem.toml").write_text(text.replace("past_inputs = 3", "past_inputs = 4"))
    with pytest.raises(UserError, match="past_inputs"):
        go(problem, tmp_path / "runs")
    assert ledger.read_bytes() == before


@pytest.mark.slow
def test_what_is_no_model_is_invalid_and_a_best_candidate_that_luck_made_is_told(
    problem: Path, tmp_path: Path
) -> None:
    (problem / "baseline.py").write_text(NOISE)
    draw = "import os\n    weights *= 1 - int.from_bytes(os.urandom(4), 'big') / 2**36\n    "
    lucky = arx(2).replace("context.log", draw + "context.log")
    odd = Scripted(("def fit(:", "x = '\ud800'\ndef fit(t, c): ...", "#" * 70_000, lucky))
    view = go(problem, tmp_path / "runs", odd, experiments=5)
    statuses = [e.result.status for e in view.finished if e.result]
    assert statuses == ["invalid", "invalid", "invalid", "invalid", "keep"]
    failure = view.experiment(1).failure
    assert failure is not None
    assert failure.reason is Reason.NOT_REPRODUCIBLE
    assert view.best is not None
    assert view.best.number == 5
    assert view.refitted is not None
    assert view.refitted.again is not None
    assert view.refitted.again.value not in (None, 1.0)
    assert "V varies over repeated fits" in second_fit_text(view.refitted.again)


@pytest.mark.slow
def test_unseal_once(whole: Path, tmp_path: Path) -> None:
    problem, directory = tmp_path / "toy", whole
    first = unseal(directory, process_consent=True)
    assert first.first_time
    measured = open_run(directory).store.get_arrays(
        first.record.measured, [(n, 1) for n in first.record.lengths]
    )
    table = np.loadtxt(problem / "test.csv", delimiter=",", skiprows=1)
    assert np.array_equal(measured[0][:, 0], table[3:, 1])
    assert first.record.ensemble.scores[0].value < 0.05
    bands = first.record.bands
    assert bands is not None
    shapes = [(n, 1) for n in first.record.lengths]
    lower, upper = (
        open_run(directory).store.get_arrays(edge, shapes)[0] for edge in (bands.lower, bands.upper)
    )
    held = np.mean((lower <= measured[0]) & (measured[0] <= upper))
    assert bands.covered == pytest.approx((held,))
    assert held > 0.8
    assert bands.outside < 0.5
    again = unseal(directory, process_consent=True)
    assert not again.first_time
    assert again.record == first.record
    assert open_run(directory).state == "unsealed"
    with pytest.raises(UserError, match="unsealed"):
        go(problem, tmp_path / "runs", experiments=6)
    verify(directory)


RUNAWAY = """
import numpy as np


class Model:
    def simulate(self, past_u, past_y, u):
        grown = np.where(np.abs(u[:, :, :1]).max() > 3.0, np.inf, 1.0)
        return 0.0 * u[:, :, :1] * 1.0 + grown


def fit(trajectories, context):
    return Model()
"""


@pytest.mark.slow
def test_a_best_candidate_that_runs_away_on_the_test_is_recorded(
    problem: Path, tmp_path: Path
) -> None:
    table = np.loadtxt(problem / "test.csv", delimiter=",", skiprows=1)
    table[50, 0] = 10.0
    np.savetxt(problem / "test.csv", table, delimiter=",", header="u,y", comments="")
    (problem / "baseline.py").write_text(RUNAWAY)
    go(problem, tmp_path / "runs", Scripted(()), experiments=2)
    directory = tmp_path / "runs" / "toy-scripted-s0"
    result = unseal(directory, process_consent=True)
    assert isinstance(result.record.ensemble, Failure)
    assert result.record.ensemble.reason is Reason.NOT_FINITE
    assert open_run(directory).state == "unsealed"
    verify(directory)


def test_a_changed_lock_is_refused_by_resume_and_unseal(finished: Path, tmp_path: Path) -> None:
    problem, directory = tmp_path / "toy", finished
    lock = directory / "problem.lock.toml"
    text = lock.read_text()
    lock.write_text(text + "\n")
    with pytest.raises(UserError, match="changed after the search began"):
        unseal(directory, process_consent=True)
    with pytest.raises(UserError, match="changed after the search began"):
        go(problem, tmp_path / "runs")
    lock.unlink()
    with pytest.raises(UserError, match="is missing"):
        go(problem, tmp_path / "runs")
    with pytest.raises(UserError, match="is missing"):
        verify(directory)


@pytest.mark.slow
def test_a_saturated_search_goes_on_when_extended(problem: Path, tmp_path: Path) -> None:
    text = (problem / "problem.toml").read_text()
    (problem / "problem.toml").write_text(text + "patience = 1\n")
    agent = Scripted((arx(2), CRASH, CRASH.replace("such", "more"), arx(3)))
    first = go(problem, tmp_path / "runs", agent, experiments=4)
    assert first.stopped is not None
    assert first.stopped.reason == "saturated"
    more = go(problem, tmp_path / "runs", agent, experiments=5)
    assert len(more.finished) == len(first.finished) + 1


@pytest.mark.long
def test_a_model_that_diverges_as_one_did_before_costs_no_experiment(
    problem: Path, tmp_path: Path
) -> None:
    far = [NOISE.replace("+ u[", f"+ {k}e4 * u[").replace("1e-9 *", "0.0 *") for k in (1, 2, 3)]
    agent = Scripted((*far, arx(2), arx(3)))
    view = go(problem, tmp_path / "runs", agent, experiments=4)
    assert [e.diverged for e in view.finished] == [False, True, True, True, False]
    assert view.uncounted == 1
    assert view.stopped is not None
    assert view.stopped.reason == "budget"
    verify(tmp_path / "runs" / "toy-scripted-s0")


@pytest.mark.parametrize("hours", [0.0, -1.0, float("nan")])
def test_hours_must_be_positive(problem: Path, tmp_path: Path, hours: float) -> None:
    loaded = load_problem(problem)
    loaded = replace(loaded, budget=replace(loaded.budget, hours=hours))
    with pytest.raises(UserError, match="more than 0"):
        prepare(loaded, "expert", seed=0, runs=tmp_path / "runs")
    assert not (tmp_path / "runs").exists()


@pytest.mark.usefixtures("finished")
def test_a_budget_cannot_shrink(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="can only grow"):
        go(tmp_path / "toy", tmp_path / "runs", experiments=1)


def test_the_best_candidate_simulates(finished_once: Path) -> None:
    directory = finished_once / "runs" / "toy-scripted-s0"
    table = np.loadtxt(finished_once / "toy" / "train.csv", delimiter=",", skiprows=1)
    u, y = table[:, :1], table[:, 1:]
    for model in ("ensemble", "refit"):
        y_hat = simulate(directory, u[:3], y[:3], u[3:], model)
        assert np.sqrt(np.mean((y_hat - y[3:]) ** 2)) < 0.1 * y.std()
    with pytest.raises(UserError, match="past_y has shape"):
        simulate(directory, u[:3], y[:2], u[3:])


@pytest.mark.slow
@pytest.mark.parametrize("model", ["refit"])
def test_the_best_candidate_simulates_with_bands(finished_once: Path, model: Use) -> None:
    directory = finished_once / "runs" / "toy-scripted-s0"
    table = np.loadtxt(finished_once / "toy" / "train.csv", delimiter=",", skiprows=1)
    u, y = table[:, :1], table[:, 1:]
    found = simulate(directory, u[:3], y[:3], u[3:], model, bands=0.9)
    assert np.array_equal(found.y_hat, simulate(directory, u[:3], y[:3], u[3:], model))
    assert np.all(found.lower <= found.y_hat)
    assert np.all(found.y_hat <= found.upper)
    assert np.mean((found.lower <= y[3:]) & (y[3:] <= found.upper)) > 0.85
    assert np.mean(found.outside) < 0.05
    far = simulate(directory, u[:3], y[:3], 10.0 * u[3:], model, bands=0.9)
    assert np.mean(far.outside) > 0.8
    assert np.mean(far.upper - far.lower) > 2.0 * np.mean(found.upper - found.lower)
    with pytest.raises(UserError, match="between 0 and 1"):
        simulate(directory, u[:3], y[:3], u[3:], model, bands=90.0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("level", "number", "code", "word"),
    [
        ("process", signal.SIGINT, 130, b"interrupted"),
        ("strongest", signal.SIGTERM, 143, b"terminated"),
    ],
)
def test_an_interrupt_ends_the_workers_at_once(
    problem: Path, tmp_path: Path, level: str, number: signal.Signals, code: int, word: bytes
) -> None:
    slow = "def fit(t, c):\n    import time\n    time.sleep(19)\n"
    (problem / "baseline.py").write_text(slow)
    command = [Path(sys.executable).with_name("asia"), "run", problem, "--experiments", "1"]
    command += ["--isolation", level] if level == "process" else []
    process = subprocess.Popen([str(c) for c in command], cwd=tmp_path, stderr=subprocess.PIPE)
    ledger = tmp_path / "runs" / "toy-expert-s0" / "ledger.jsonl"
    while not ledger.is_file() or b'"proposed"' not in ledger.read_bytes():
        assert process.poll() is None
        time.sleep(0.1)
    time.sleep(1.0)
    begin = time.monotonic()
    process.send_signal(number)
    _, said = process.communicate(timeout=60)
    assert process.returncode == code
    assert word + b"; the same command continues from here" in said
    assert b"Traceback" not in said
    assert time.monotonic() - begin < 15
    assert not in_use(ledger)
    assert verify(ledger.parent).torn == 0
    assert open_run(ledger.parent).view.pending is not None


@pytest.mark.slow
def test_changed_test_data_are_not_opened(problem: Path, tmp_path: Path) -> None:
    go(problem, tmp_path / "runs", experiments=2)
    lines = (problem / "test.csv").read_text().splitlines()
    (problem / "test.csv").write_text("\n".join([*lines[:-1], "0.0,0.0"]) + "\n")
    with pytest.raises(UserError, match="test"):
        unseal(tmp_path / "runs" / "toy-scripted-s0")


def test_agents_see_no_time_and_no_validation_outputs(finished_once: Path) -> None:
    run = open_run(finished_once / "runs" / "toy-scripted-s0")
    facts = problem_facts(load_problem(finished_once / "toy"))
    trials = agent_view(facts, run.view, run.store).trials
    assert len(trials) == 4
    seen = " ".join(vars(trials[0]))
    assert not any(word in seen for word in ("second", "time", "y_hat", "model"))
