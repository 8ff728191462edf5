"""The top candidates of a finished search fitted again: what is fitted, kept, ranked, refused."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from asia.analysis.confirmation import confirm
from asia.errors import UserError
from asia.judge.evaluation.fold_fits import derive_seed
from asia.ledger.chain import Chain
from asia.ledger.events import Confirmed, Fit
from asia.ledger.run import open_run
from asia.ledger.verification import verify
from asia.problem.load import load_problem
from asia.search.run import prepare, search
from tests.unit.search.toy import CRASH, Scripted, arx, write_problem

# The weights of an ARX fit, moved by luck of a size that depends on the candidate.
LUCKY = arx(2).replace(
    "    context.log(",
    "    weights = weights * (1 + SIZE * np.random.default_rng(context.seed).normal("
    "size=weights.shape))\n    context.log(",
)
FICKLE = LUCKY.replace("    context.log(", "    assert context.seed in KNOWN\n    context.log(")


def lucky(size: float) -> str:
    return LUCKY.replace("SIZE", str(size))


def searched(root: Path, *sources: str) -> Path:
    problem = write_problem(root / "toy", experiments=1 + len(sources))
    agent = Scripted(sources)
    ready = prepare(load_problem(problem), agent.name, seed=0, runs=root / "runs")
    search(ready, agent, lambda event, view: None, lambda view: None)
    return ready.directory


@pytest.fixture(scope="module")
def once(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return searched(tmp_path_factory.mktemp("once"), lucky(0.01), lucky(0.02), arx(2))


@pytest.fixture
def run(once: Path, tmp_path: Path) -> Path:
    root = tmp_path / "copy"
    shutil.copytree(once.parent.parent, root)
    return root / "runs" / once.name


def quietly(event: Fit, done: int, total: int) -> None:
    assert 1 <= done <= total


@pytest.mark.long
def test_seeds_are_fresh_and_a_fit_without_luck_is_repeated_once(run: Path) -> None:
    heard: list[Fit] = []
    found, new = confirm(run, lambda event, done, total: heard.append(event), top=3, seeds=3)
    assert new
    by_number = {c.experiment: c for c in found.candidates}
    fixed = by_number[4]
    assert fixed.deterministic
    assert (fixed.repeats, fixed.spread) == (1, 0.0)
    assert fixed.value.value == fixed.first
    for number in (2, 3):
        assert by_number[number].repeats == 3
        assert not by_number[number].deterministic
        assert by_number[number].value.value != by_number[number].first
    values = {(e.experiment, e.value) for e in heard if e.value is not None}
    assert len(values) == len(heard) == 7
    assert found.noise is not None
    assert found.noise > 0
    assert found.tried == 4
    assert [c.value.value for c in found.candidates] == sorted(
        c.value.value for c in found.candidates
    )
    assert found.candidates[0].experiment == 4
    assert found.expected is not None
    assert found.expected.low < found.expected.value < found.expected.high
    assert found.ensemble is not None
    assert found.ensemble.value <= found.expected.value
    assert all(c.best_rank <= c.worst_rank for c in found.candidates)
    verify(run)
    view = open_run(run).view
    assert view.confirmed == found
    assert view.complete


@pytest.mark.slow
def test_what_is_in_the_ledger_is_not_fitted_again(run: Path) -> None:
    first, _ = confirm(run, quietly, top=2, seeds=2)
    ledger = run / "ledger.jsonl"
    whole = ledger.read_bytes()
    heard: list[Fit] = []

    def listen(event: Fit, done: int, total: int) -> None:
        heard.append(event)

    again, new = confirm(run, listen, top=2, seeds=2)
    assert (again, new, heard) == (first, False, [])
    assert ledger.read_bytes() == whole
    # Killed before its last two lines, it makes up for them alone, and comes to the same.
    ledger.write_bytes(b"".join(whole.splitlines(keepends=True)[:-2]))
    resumed, new = confirm(run, listen, top=2, seeds=2)
    assert new
    assert resumed == first
    assert len(heard) == 1
    heard.clear()
    more, _ = confirm(run, listen, top=2, seeds=3)
    assert all(event.seed == 3 for event in heard)
    assert more.seeds == 3


@pytest.mark.long
def test_a_search_that_goes_on_is_no_longer_confirmed_and_keeps_its_repeats(run: Path) -> None:
    confirm(run, quietly, top=1, seeds=1)
    problem = load_problem(run.parent.parent / "toy")
    problem = replace(problem, budget=replace(problem.budget, experiments=5))
    agent = Scripted((lucky(0.01), lucky(0.02), arx(2), arx(3)))
    ready = prepare(problem, agent.name, seed=0, runs=run.parent)
    view = search(ready, agent, lambda event, view: None, lambda view: None)
    assert view.confirmed is None
    assert len(view.fits) == 1
    assert len(view.experiments) == 5
    verify(run)


@pytest.mark.slow
def test_a_ledger_that_has_a_repeat_twice_is_refused(run: Path) -> None:
    confirm(run, quietly, top=1, seeds=1)
    view = open_run(run).view
    with Chain(run / "ledger.jsonl") as chain:
        chain.append(view.fits[0])
    with pytest.raises(UserError, match="twice"):
        verify(run)
    with pytest.raises(UserError, match="twice"):
        open_run(run)


@pytest.mark.long
def test_a_seed_that_fails_is_counted_and_left_out(tmp_path: Path) -> None:
    # Seeds of the search, by fold: whatever else comes is beyond its luck.
    own = [derive_seed(derive_seed(0, "search"), fold, 0) for fold in (0, 1)]
    other = [derive_seed(derive_seed(0, "search"), fold, 2) for fold in (0, 1)]
    source = FICKLE.replace("SIZE", "0.01").replace("KNOWN", str([*own, *other]))
    directory = searched(tmp_path, source)
    found, _ = confirm(directory, quietly, top=1, seeds=3)
    repeats = open_run(directory).view.fits
    assert [r.value is None for r in repeats] == [True, False, True]
    (one,) = found.candidates
    assert (one.failed, one.repeats, one.spread) == (2, 1, None)
    assert found.noise is None
    none, _ = confirm(directory, quietly, top=1, seeds=1)
    assert (none.candidates, none.failed) == ((), (2,))
    assert none.expected is not None


@pytest.mark.parametrize("cut", [1, 2])
def test_an_unfinished_search_is_refused(finished: Path, cut: int) -> None:
    ledger = finished / "ledger.jsonl"
    ledger.write_bytes(b"".join(ledger.read_bytes().splitlines(keepends=True)[:-cut]))
    with pytest.raises(UserError, match="not finished"):
        confirm(finished, quietly)


@pytest.mark.long
def test_a_search_without_scores_or_artifacts_is_refused(tmp_path: Path, run: Path) -> None:
    problem = write_problem(tmp_path / "bad" / "toy", experiments=1)
    (problem / "baseline.py").write_text(CRASH)
    ready = prepare(load_problem(problem), "scripted", seed=0, runs=tmp_path / "bad" / "runs")
    search(ready, Scripted(()), lambda event, view: None, lambda view: None)
    with pytest.raises(UserError, match="no candidate with a score"):
        confirm(ready.directory, quietly)
    shutil.rmtree(run / "artifacts")
    with pytest.raises(UserError, match="artifacts"):
        confirm(run, quietly)


def test_the_last_event_is_the_confirmation(finished: Path) -> None:
    found, _ = confirm(finished, quietly, top=1, seeds=1)
    last = open_run(finished).lines[-1].event
    assert isinstance(last, Confirmed)
    assert last == found
