import hashlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from asia.errors import UserError
from asia.ledger.artifacts import Store
from asia.ledger.chain import BEGIN, Chain, _line, read_lines
from asia.ledger.events import Evaluated, Fit, Started, Unsealed, adapter
from asia.ledger.events import TestedModel as Record
from asia.ledger.run import find_run, open_run
from asia.ledger.verification import verify
from asia.presentation.experiments import describe_result
from asia.presentation.exports import journal, results_table
from asia.search.run import check_same_search

from .conftest import evaluated, finished_run, proposed, score, started


def test_replay_tells_the_search(run: Path) -> None:
    view = open_run(run).view
    assert [e.number for e in view.finished] == [1, 2, 3]
    assert view.best is not None
    assert view.best.number == 3
    assert view.experiment(2).failure is not None
    assert view.pending is None


def test_a_failure_is_an_empty_cell_never_a_number(run: Path) -> None:
    rows = results_table(open_run(run).view).splitlines()
    assert rows[0] == "experiment\tval\tstatus\tdescription\tparent\tseconds\tfolds"
    assert rows[2].split("\t") == ["2", "", "crash", "t2", "", "1.0", ""]


def test_the_journal_has_its_five_fields(run: Path) -> None:
    text = journal(open_run(run).view)
    for field in ("Changed", "Hypothesis", "Result", "Decision", "Next"):
        assert text.count(f"**{field}:**") == 3
    assert "ValueError: x" in text
    assert "Reference models, V: linear model 0.5000." in text


def test_two_writers_are_refused(run: Path) -> None:
    with Chain(run / "ledger.jsonl"):
        assert open_run(run).state == "running"
        with pytest.raises(UserError, match="in use"):
            Chain(run / "ledger.jsonl")
    assert open_run(run).state == "interrupted"


def test_verify_names_a_damaged_artifact(run: Path) -> None:
    lock = run / "problem.lock.toml"
    lock.write_text("")
    path = run / "ledger.jsonl"
    digest = hashlib.sha256(b"").hexdigest()
    assert digest  # the fixture's lock digest is made up, so the lock is what fails last
    with pytest.raises(UserError, match=r"problem\.lock\.toml was changed"):
        verify(run)
    artifact = next((run / "artifacts").iterdir())
    artifact.write_bytes(b"other")
    with pytest.raises(UserError, match="was changed after it was written"):
        verify(run)
    assert path.is_file()


def test_artifacts_keep_arrays_bitwise(tmp_path: Path) -> None:
    store = Store(tmp_path / "artifacts")
    rng = np.random.default_rng(0)
    arrays = [rng.normal(size=(7, 2)), rng.normal(size=(3, 2))]
    digest = store.put_arrays(arrays)
    back = store.get_arrays(digest, [a.shape for a in arrays])
    assert all(a.tobytes() == b.tobytes() for a, b in zip(arrays, back, strict=True))
    with pytest.raises(UserError, match="numbers"):
        store.get_arrays(digest, [(7, 2)])
    with pytest.raises(UserError, match="missing"):
        store.get("0" * 64)


def test_runs_are_found_by_name_by_path_and_by_age(run: Path) -> None:
    assert find_run(run.parent, "toy") == run
    assert find_run(Path("elsewhere"), str(run)) == run
    assert find_run(run.parent, None) == run
    with pytest.raises(UserError, match="there is: toy"):
        find_run(run.parent, "other")
    with pytest.raises(UserError, match="asia run"):
        find_run(run / "artifacts", None)


def test_an_unsealing_without_a_table_still_reads() -> None:
    """Ledgers from before windows existed hold neither a table nor a horizon."""
    scores = [{"metric": "rmse", "value": 1.0, "per_channel": [1.0], "per_trajectory": [1.0]}]
    old = {
        "event": "unsealed",
        "experiment": 1,
        "test_digest": "0" * 64,
        "channels": ["y"],
        "trajectories": ["t"],
        "lengths": [9],
        "skip": 0,
        "measured": "a",
        "ensemble": {"scores": scores, "y_hat": "b"},
        "refit": None,
    }
    event = adapter.validate_python(old)
    assert isinstance(event, Unsealed)
    assert event.horizon is None
    assert isinstance(event.ensemble, Record)
    assert event.ensemble.mee is None


def test_a_row_has_the_whole_hypothesis_the_parent_the_time_and_the_folds(run: Path) -> None:
    view = open_run(run).view
    third = view.experiments[2]
    words = "a lag behind the pump, " + 30 * "and more "
    handed_in = replace(third.proposed, title=words[:79] + "…", hypothesis=words, parent=1)
    view = replace(view, experiments=(*view.experiments[:2], replace(third, proposed=handed_in)))
    cells = results_table(view).splitlines()[3].split("\t")
    assert cells[3:6] == [words, "1", "1.0"]
    assert third.score is not None
    assert cells[6] == " ".join(f"{fold.value:.6f}" for fold in third.score.folds)


def test_a_mean_over_seeds_is_called_one(run: Path) -> None:
    view = open_run(run).view
    third = view.experiments[2]
    assert third.result is not None
    assert third.score is not None
    value = third.score.value
    again = (Fit(7, "retest", value + 0.03), Fit(8, "retest", value + 0.06))
    seeds = replace(third, result=replace(third.result, retests=again))
    view = replace(view, experiments=(*view.experiments[:2], seeds))
    cells = results_table(view).splitlines()[3].split("\t")
    assert cells[1] == f"{value:.6f}"
    assert cells[3] == f"{third.proposed.title} (mean of 3 seeds {value + 0.03:.4f})"
    assert f"mean of 3 seeds {value + 0.03:.4f}" in describe_result(seeds, view)
    assert f"mean of 3 seeds {value + 0.03:.4f}" in journal(view)
    assert "mean of" not in describe_result(third, view)


def test_no_text_of_an_agent_is_a_formula_in_the_table(tmp_path: Path) -> None:
    store = Store(tmp_path / "artifacts")
    with Chain(tmp_path / "ledger.jsonl") as chain:
        chain.append(started())
        chain.append(replace(proposed(store, 1), title="=1+1", hypothesis="=1+1"))
        chain.append(evaluated(1, "keep", score(0.5)))
        assert results_table(chain.view).splitlines()[1].split("\t")[3] == "'=1+1"


def test_a_run_with_lessons_of_an_older_version_verifies_and_shows_but_does_not_resume(
    tmp_path: Path,
) -> None:
    directory = finished_run(tmp_path / "run")
    ledger = directory / "ledger.jsonl"
    events = [line.event for line in read_lines(ledger)]
    digest = Store(directory / "artifacts").put(b"[]")
    ledger.unlink()
    with Chain(ledger) as chain:
        for event in events:
            chain.append(replace(event, lessons=digest) if isinstance(event, Started) else event)
    verify(directory)
    view = open_run(directory).view
    assert view.started.lessons == digest
    with pytest.raises(UserError, match="choose another --name"):
        check_same_search(view, replace(view.started, lessons=None))
    (directory / "artifacts" / digest).unlink()
    with pytest.raises(UserError, match=digest[:8]):
        verify(directory)


def test_the_threshold_is_read_by_its_name_in_older_ledgers() -> None:
    event = replace(evaluated(1, "keep", score(0.5)), threshold=0.1)
    fields = adapter.dump_python(event, mode="json")
    older = {("floor" if name == "threshold" else name): value for name, value in fields.items()}
    assert "threshold" not in older
    assert adapter.validate_python(older) == event


def test_a_run_on_a_gpu_of_an_older_version_verifies_and_shows_but_does_not_resume(
    tmp_path: Path,
) -> None:
    directory = finished_run(tmp_path / "run")
    ledger = directory / "ledger.jsonl"
    place, raw = BEGIN, b""
    for line in read_lines(ledger):
        fields = adapter.dump_python(line.event, mode="json")
        fields |= {"device": "gpu"} if isinstance(line.event, Started) else {}
        outcome = fields["outcome"] if isinstance(line.event, Evaluated) else {}
        for fold in outcome.get("folds", ()):
            fold["device"] = "gpu NVIDIA H100"
        record, _ = _line(place.seq, place.head, line.time, fields)
        place, raw = place.behind(record), raw + record
    assert raw.count(b"NVIDIA") == 2
    ledger.write_bytes(raw)
    verify(directory)
    view = open_run(directory).view
    assert len(view.experiment(1).result.folds) == 2
    assert str(view.best) == str(open_run(finished_run(tmp_path / "other")).view.best)
    with pytest.raises(UserError, match="started with --device gpu, which this version does not"):
        check_same_search(view, replace(view.started, device="cpu"))
