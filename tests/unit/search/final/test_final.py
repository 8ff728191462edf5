"""Results at the end of a search: a refit that was checked, a stack, and the model to use."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from asia.data import Array
from asia.errors import CandidateError, Reason, UserError
from asia.judge.evaluation.fold_fits import derive_seed
from asia.judge.sandbox.types import Isolation
from asia.ledger.events import Refitted
from asia.ledger.evidence import identified, identified_by_folds
from asia.ledger.run import model_to_use, open_run
from asia.ledger.run import tested_model as model_of
from asia.ledger.verification import verify
from asia.ledger.view import SearchView
from asia.problem.load import load_problem
from asia.search.final import cause_of, none_words, stack_weights
from asia.search.run import prepare, search
from asia.search.simulation import simulate
from asia.search.unsealing import unseal
from tests.unit.interfaces.cli.conftest import command_line
from tests.unit.search.toy import Scripted, arx, write_problem

# The whole record of the toy; a fold trains on half of it.
WHOLE = 240
# Off by 0.663 standard deviations, which makes an error of 120 % of the standard deviation.
OFF = """


class Off:
    def __init__(self, level):
        self.level = level

    def simulate(self, past_u, past_y, u):
        return np.full((*u.shape[:2], 1), self.level)


fit_well = fit


def fit(trajectories, context):
    if {condition}:
        y = trajectories[0].y
        return Off(float(y.mean() + 0.663 * y.std()))
    return fit_well(trajectories, context)
"""
ON_ALL = f"sum(len(t) for t in trajectories) == {WHOLE}"
RESTLESS = """


class Restless(Model):
    def simulate(self, past_u, past_y, u):
        import os
        noise = np.frombuffer(os.urandom(8), "<u8")[0] / 2.0**64
        return super().simulate(past_u, past_y, u) * (1.0 + 1e-7 * noise)


fit_well = fit


def fit(trajectories, context):
    model = fit_well(trajectories, context)
    return Restless(model.weights) if sum(len(t) for t in trajectories) == 240 else model
"""
BIASED = """


class Biased(Model):
    def simulate(self, past_u, past_y, u):
        return super().simulate(past_u, past_y, u) + {share} * u


fit_well = fit


def fit(trajectories, context):
    return Biased(fit_well(trajectories, context).weights)
"""


def off(condition: str) -> str:
    return arx(2) + OFF.replace("{condition}", condition)


def biased(share: float) -> str:
    return arx(2) + BIASED.replace("{share}", str(share))


def go(folder: Path, *sources: str) -> tuple[Path, SearchView]:
    problem = load_problem(write_problem(folder / "toy", experiments=len(sources) + 1))
    agent = Scripted(sources)
    runs = folder / "runs"
    ready = prepare(problem, agent.name, seed=0, runs=runs, isolation=Isolation.PROCESS)
    view = search(ready, agent, lambda event, view: None, lambda view: None)
    return ready.directory, view


def ended(view: SearchView) -> Refitted:
    assert view.refitted is not None
    return view.refitted


def answer(directory: Path, model: str | None) -> Array:
    random = np.random.default_rng(3)
    past_u, past_y, u = (random.normal(size=(n, 1)) for n in (3, 3, 40))
    return simulate(directory, past_u, past_y, u, model=model)  # pyright: ignore[reportArgumentType]


@pytest.mark.slow
def test_a_sound_refit_is_kept_with_its_evidence(estimating: tuple[Path, SearchView]) -> None:
    refitted = ended(estimating[1])
    assert refitted.model is not None
    assert refitted.check is not None
    (start,) = refitted.check.starts
    assert start.failed == ""
    assert start.value == pytest.approx(refitted.check.ensemble_error, rel=0.2)
    assert len(refitted.check.fold_errors) == 2
    assert start.disagreement is not None
    assert refitted.check.fold_disagreement is not None
    assert 0 < start.disagreement < 3 * refitted.check.fold_disagreement
    assert refitted.use is not None
    assert refitted.reason


@pytest.mark.long
def test_a_refit_that_does_not_fit_its_own_data_is_none_and_the_search_says_so(
    tmp_path: Path,
) -> None:
    directory, view = go(tmp_path, off(ON_ALL))
    assert view.complete
    assert view.best is not None
    assert view.best.number == 2
    refitted = ended(view)
    assert refitted.model is None
    assert refitted.check is not None
    assert [start.value for start in refitted.check.starts] == [pytest.approx(1.2, rel=0.02)]
    assert refitted.use == "ensemble"
    assert refitted.reason.startswith("Errors on the training records: refit 1.2")
    verify(directory)

    for words in (("status",), ("show", directory.name)):
        shown = command_line(*words, "--runs", directory.parent)
        assert shown.code == 0
        assert refitted.reason in shown.out
    status = command_line("status", "--runs", directory.parent, "--json")
    assert json.loads(status.out)["use"] == "ensemble"
    assert (answer(directory, None) == answer(directory, "ensemble")).all()
    with pytest.raises(UserError, match="no refitted model: errors on the training records"):
        answer(directory, "refit")
    opened = command_line(
        "unseal", directory.name, "--runs", directory.parent, "--yes", "--yes-process", "--json"
    )
    told = json.loads(opened.out)
    assert "refit" not in told
    assert told["use"]["model"] == "ensemble"
    assert told["use"]["rmse"] == told["test"]["rmse"]
    assert set(told["use"]) >= {"model", "rmse", "per_channel", "per_trajectory"}


@pytest.mark.long
def test_another_start_is_tried_where_the_first_falls_short(tmp_path: Path) -> None:
    first = derive_seed(derive_seed(0, "search"), "all", 0)
    directory, view = go(tmp_path, off(f"context.seed == {first}"))
    refitted = ended(view)
    assert refitted.check is not None
    assert len(refitted.check.starts) == 2
    assert refitted.check.kept == 2
    assert refitted.model is not None
    assert np.isfinite(answer(directory, "refit")).all()


@pytest.mark.slow
def test_a_fold_model_takes_the_place_of_a_refit_in_a_poorer_minimum(tmp_path: Path) -> None:
    sound = derive_seed(derive_seed(0, "search"), 0, 0)
    source = biased(0.3)
    source += f"""


biased = fit


def fit(trajectories, context):
    return (fit_well if context.seed == {sound} else biased)(trajectories, context)
"""
    directory, view = go(tmp_path, source)
    assert view.best is not None
    assert view.best.number == 2
    refitted = ended(view)
    assert refitted.check is not None
    assert refitted.check.kept is None
    assert refitted.use == "refit"
    assert refitted.fold == 1
    assert refitted.reason.startswith("The model of fold 1 takes its place")
    assert refitted.model == view.best.folds[0].model
    shown = command_line("report", directory.name, "--runs", directory.parent)
    assert shown.code == 0, shown.err
    page = (directory / "report" / "report.html").read_text()
    assert "the model of fold 1 of the best candidate, in place of a refit" in page
    assert "fitted to all training records" not in page
    assert np.isfinite(answer(directory, None)).all()


@pytest.mark.parametrize(
    ("causes", "sentence"),
    [
        (["diverged"] * 3, "the refit diverged in all three starts"),
        (["diverged"], "the refit diverged"),
        (["failed (a)", "failed (b)"], "the refit failed in both starts (b)"),
        (
            ["diverged", "ran out of memory"],
            "no start of the refit is usable: one diverged, one ran out of memory",
        ),
    ],
)
def test_a_refit_that_failed_is_one_sentence(causes: list[str], sentence: str) -> None:
    assert none_words(causes) == sentence


def test_the_cause_of_a_failed_fit_has_no_traceback() -> None:
    trace = 'Traceback\n  File "candidate.py", line 9, in fit\nValueError: array has infs or NaNs'
    assert cause_of(CandidateError(Reason.CRASH, trace)) == "diverged"
    assert cause_of(CandidateError(Reason.NOT_FINITE)) == "diverged"
    other = trace.replace("array has infs or NaNs", "no such order")
    assert (
        cause_of(CandidateError(Reason.CRASH, other))
        == "failed (line 9: ValueError: no such order)"
    )


@pytest.mark.long
@pytest.mark.parametrize(
    ("source", "words", "sentence"),
    [
        (
            off(f"{ON_ALL} and 1 / 0"),
            'its fit failed.*File "candidate.py"',
            r"The refit failed in all three starts \(line \d+: ZeroDivisionError: .*\)\.",
        ),
        (
            off(f"{ON_ALL} and np.linalg.inv(np.zeros((1, 1)))"),
            'its fit failed.*File "candidate.py"',
            r"The refit diverged in all three starts\.",
        ),
        (
            arx(2) + RESTLESS,
            "simulates differently",
            r"The refit gives invalid simulations \(.*\)\.",
        ),
    ],
)
def test_a_refit_that_fails_or_does_not_answer_like_a_model_is_none(
    tmp_path: Path, source: str, words: str, sentence: str
) -> None:
    _, view = go(tmp_path, source)
    assert re.fullmatch(sentence, ended(view).reason), ended(view).reason
    refitted = ended(view)
    assert refitted.model is None
    assert refitted.check is not None

    assert re.search(words, refitted.check.starts[0].failed), refitted.check.starts


@pytest.mark.long
def test_a_stack_of_opposite_errors_is_used_and_opened(tmp_path: Path) -> None:
    directory, view = go(tmp_path, biased(0.2), biased(-0.2))
    refitted = ended(view)
    assert refitted.stack is not None
    assert view.best is not None
    assert view.best.score is not None
    assert refitted.use == "stack"
    assert refitted.stack.value < 0.6 * view.best.score.value
    assert refitted.stack.value == pytest.approx(np.mean(refitted.stack.folds))
    weights = {m.experiment: m.weight for m in refitted.stack.members}
    assert sum(weights.values()) == pytest.approx(1.0)
    scores = {e.number: e.score for e in view.finished if e.score is not None}
    values = np.array([[fold.value for fold in score.folds] for score in scores.values()]).T
    for number, weight in zip(scores, stack_weights(values), strict=True):
        assert weights.get(number, 0.0) == pytest.approx(weight)
    assert (answer(directory, None) == answer(directory, "stack")).all()
    assert not np.allclose(answer(directory, "stack"), answer(directory, "ensemble"), atol=0.05)
    record = unseal(directory, process_consent=True).record
    assert record.stack is not None
    stack, ensemble = (model_of(record, use) for use in ("stack", "ensemble"))
    assert stack.scores[0].value < 0.6 * ensemble.scores[0].value
    verify(directory)


@pytest.mark.long
def test_a_member_that_does_not_answer_like_a_model_is_left_out(tmp_path: Path) -> None:
    # It was no new best, so that nobody had asked it before.
    restless = RESTLESS.replace("fit_well", "fit_biased").replace("== 240", "> 0")
    source = biased(-0.21) + restless.replace("Restless(Model)", "Restless(Biased)")
    _, view = go(tmp_path, biased(0.2), source)
    assert [e.result.status for e in view.finished if e.result] == ["keep", "keep", "discard"]
    assert all(e.score is not None for e in view.finished)
    stack = ended(view).stack
    assert stack is None or 3 not in {m.experiment for m in stack.members}


@pytest.mark.long
def test_one_candidate_makes_no_stack(tmp_path: Path) -> None:
    directory, view = go(tmp_path)
    assert ended(view).stack is None
    with pytest.raises(UserError, match="has no stack"):
        answer(directory, "stack")
    with pytest.raises(UserError, match="expected None or one of"):
        answer(directory, "best")


def test_a_ledger_of_an_older_version_names_the_ensemble(tmp_path: Path) -> None:
    golden = Path(__file__).parents[3] / "golden" / "0.1.0" / "runs" / "unsealed"
    shutil.copytree(golden, tmp_path / "unsealed")
    named = model_to_use(open_run(tmp_path / "unsealed").view)
    assert named is not None
    assert named.model == "ensemble"
    assert "older version" in named.reason
    record = open_run(tmp_path / "unsealed").view.unsealed
    assert record is not None
    assert model_of(record, named.model) == record.ensemble


ESTIMATES = """


class Estimating(Model):
    def parameters(self):
        return {f"w{i}": float(w) for i, w in enumerate(self.weights[:, 0])}

    def estimates(self, trajectories, context):
        from asia.candidate import ParameterEstimate, ParameterEstimates
        rows = tuple(ParameterEstimate(n, v, 0.1, v - 0.2, v + 0.2, lower=-5.0, upper=5.0)
                     for n, v in self.parameters().items())
        samples = sum(len(t) for t in trajectories)
        return ParameterEstimates(rows, np.eye(len(rows)), (f"fitted to {samples} samples",))


fit_well = fit


def fit(trajectories, context):
    return Estimating(fit_well(trajectories, context).weights)
"""


@pytest.fixture(scope="module")
def estimating(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, SearchView]:
    """A search whose best candidate says how well its parameters are known."""
    return go(tmp_path_factory.mktemp("estimating"), arx(2) + ESTIMATES)


@pytest.mark.slow
def test_what_the_refit_says_of_its_parameters_is_kept_and_shown(
    estimating: tuple[Path, SearchView],
) -> None:
    """By any candidate that has `estimates`, from all training records; in its ledger as an
    artifact that verifies; for people and scripts."""
    directory, view = estimating
    assert view.best is not None
    assert view.best.number == 2
    found = identified(open_run(directory))
    assert found is not None
    assert found.equations == (f"fitted to {WHOLE} samples",)
    assert [len(one.folds) for one in found.parameters] == [2] * 5
    assert all(one.fold_error is not None for one in found.parameters)
    # What an experiment without a refit shows.
    by_folds = identified_by_folds(open_run(directory), view.best, library=False)
    assert by_folds is not None
    for one, other in zip(by_folds.parameters, found.parameters, strict=True):
        assert one.folds == other.folds
        assert one.fitted.value == pytest.approx(np.mean(one.folds))
        assert one.interval is None
    verify(directory)
    words = "show", directory.name, "--runs", directory.parent
    shown = json.loads(command_line(*words, "--json").out)
    assert [one["name"] for one in shown["parameters"]] == [f"w{i}" for i in range(5)]
    assert "identified model" in command_line(*words).out
    assert json.loads(command_line(*words, "1", "--json").out)["parameters"] is None
    (directory / "artifacts" / str(ended(view).estimates)).write_bytes(b"{}")
    with pytest.raises(UserError, match="changed"):
        verify(directory)
