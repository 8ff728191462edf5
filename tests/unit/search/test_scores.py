"""V and test errors recomputed from stored simulations when a run is verified."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from asia.errors import UserError
from asia.judge.scoring.outcome import Score
from asia.ledger.artifacts import Store
from asia.ledger.chain import Chain, read_lines
from asia.ledger.events import Evaluated, Event, Unsealed
from asia.ledger.events import TestedModel as Record
from asia.ledger.run import open_run
from asia.ledger.verification import verify
from asia.search.scores import ScoreCheck
from asia.search.unsealing import unseal
from tests.unit.interfaces.cli.conftest import command_line

from .toy import CRASH, arx, search_toy

Forge = Callable[[Event, Store], Event]


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run with a crash and a twin, beside its problem, which a test changes."""
    return search_toy(tmp_path_factory.mktemp("scores"), arx(2), CRASH, arx(2))


@pytest.fixture(scope="module")
def unsealed(finished: Path) -> Path:
    copy = finished.parent / "unsealed"
    shutil.copytree(finished, copy)
    unseal(copy, process_consent=True)
    return copy


def forged(run: Path, copy: Path, forge: Forge) -> Path:
    """A copy of a run with other events, every digest computed again."""
    shutil.copytree(run, copy)
    (copy / "ledger.jsonl").unlink()
    store = Store(copy / "artifacts")
    with Chain(copy / "ledger.jsonl") as chain:
        for line in read_lines(run / "ledger.jsonl"):
            chain.append(forge(line.event, store))
    assert verify(copy).records == len(open_run(run).lines)
    return copy


def value(event: Event, store: Store) -> Event:
    if isinstance(event, Evaluated) and event.experiment == 2:
        assert isinstance(event.outcome, Score)
        return replace(event, outcome=replace(event.outcome, value=0.25 * event.outcome.value))
    return event


def fold_rmse(event: Event, store: Store) -> Event:
    if isinstance(event, Evaluated) and event.experiment == 2:
        assert isinstance(event.outcome, Score)
        first, second = event.outcome.folds
        better = replace(second, rmse=tuple(0.999 * e for e in second.rmse))
        return replace(event, outcome=replace(event.outcome, folds=(first, better)))
    return event


def no_simulations(event: Event, store: Store) -> Event:
    if isinstance(event, Evaluated) and event.experiment == 2:
        assert isinstance(event.outcome, Score)
        return replace(event, outcome=replace(event.outcome, folds=()))
    return event


def short_simulation(event: Event, store: Store) -> Event:
    if isinstance(event, Evaluated) and event.experiment == 2:
        assert isinstance(event.outcome, Score)
        first, second = event.outcome.folds
        empty = replace(first, y_hat=store.put(b""))
        return replace(event, outcome=replace(event.outcome, folds=(empty, second)))
    return event


def error_of_test(event: Event, store: Store) -> Event:
    if isinstance(event, Unsealed):
        assert isinstance(event.refit, Record)
        (one,) = event.refit.scores
        return replace(event, refit=replace(event.refit, scores=(replace(one, value=0.0),)))
    return event


def outputs_of_test(event: Event, store: Store) -> Event:
    """The simulation of the ensemble in place of the measurement, and no error."""
    if isinstance(event, Unsealed):
        assert isinstance(event.ensemble, Record)
        (one,) = event.ensemble.scores
        none = replace(one, value=0.0, per_channel=(0.0,), per_trajectory=(0.0,))
        ensemble = replace(event.ensemble, scores=(none,))
        return replace(event, measured=event.ensemble.y_hat, ensemble=ensemble)
    return event


@pytest.mark.parametrize(
    ("forge", "expected"),
    [
        (value, r"experiment 2: V is 0\.\d+ in the ledger, but 0\.\d+ recomputed"),
        (fold_rmse, r"experiment 2: V of fold 2 rmse 1 is"),
        (no_simulations, "experiment 2 has V, but simulations of 0 folds: expected 2"),
        (short_simulation, "experiment 2 has V, but its simulations cannot be scored"),
        (error_of_test, r"test rmse of the refit is 0\.0 in the ledger"),
        (outputs_of_test, "the stored test outputs are not those of the test"),
    ],
)
def test_a_forged_score_is_found(
    finished: Path, unsealed: Path, tmp_path: Path, forge: Forge, expected: str
) -> None:
    run = unsealed if "test" in forge.__name__ else finished
    copy = forged(run, tmp_path / "copy", forge)
    with pytest.raises(UserError, match=expected):
        verify(copy, check=ScoreCheck(copy))
    done = command_line("verify", copy)
    assert done.code == 2
    assert done.out == ""
    assert "event " in done.err


def test_a_forged_best_candidate_is_not_unsealed(finished: Path, tmp_path: Path) -> None:
    copy = forged(finished, tmp_path / "copy", value)
    with pytest.raises(UserError, match="experiment 2: V is"):
        unseal(copy, process_consent=True)
    assert open_run(copy).view.unsealing is None


def test_an_intact_run_has_its_scores(finished: Path, unsealed: Path) -> None:
    done = command_line("verify", finished)
    assert done.code == 0, done.err
    assert "recomputed from the simulations: V of 3 experiments\n" in done.out
    done = command_line("verify", unsealed)
    assert done.code == 0, done.err
    assert "V of 3 experiments, test errors of 2 models\n" in done.out


def test_a_run_without_its_data_says_so(unsealed: Path, tmp_path: Path) -> None:
    problem = unsealed.parents[1] / "toy"
    away = {name: (problem / name).read_bytes() for name in ("test.csv", "train.csv")}
    try:
        (problem / "test.csv").unlink()
        done = command_line("verify", unsealed)
        assert done.code == 0, done.err
        assert "test errors of 2 models\n" in done.out
        assert "test outputs not compared with the test data: " in done.out
        (problem / "train.csv").write_bytes(away["train.csv"].rpartition(b"\n-")[0] + b"\n")
        done = command_line("verify", unsealed)
        assert done.code == 0, done.err
        assert "V not recomputed: " in done.out
        assert "training record 'train' changed" in done.out
    finally:
        for name, data in away.items():
            (problem / name).write_bytes(data)
    shutil.copytree(unsealed, tmp_path / "bare", ignore=lambda *_: ["artifacts"])
    done = command_line("verify", tmp_path / "bare")
    assert done.code == 0, done.err
    assert "V not recomputed: the simulations are not in this folder" in done.out
