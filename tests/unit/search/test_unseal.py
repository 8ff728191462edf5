"""An encrypted test from its sealing to its opening, and what level process asks."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from asia.errors import UserError
from asia.interfaces.coding_agents.session import CommandRules
from asia.judge.sandbox.availability import probe
from asia.judge.sandbox.types import Isolation
from asia.ledger.chain import read_lines
from asia.ledger.events import Started, Unsealed, Unsealing
from asia.ledger.run import open_run
from asia.ledger.verification import verify
from asia.problem.create import init_problem
from asia.problem.load import load_problem
from asia.search.run import check_hidden_from_agent, check_run_is_hidden, prepare, search
from asia.search.unsealing import needs_consent, unseal

from .toy import Scripted, arx, write_problem

STRONG = probe().level is not Isolation.PROCESS


@pytest.fixture
def keys(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("ASIA_KEYS", str(tmp_path / "keys"))
    return tmp_path / "keys"


def encrypted(root: Path) -> Path:
    """The toy, its test encrypted."""
    toy = write_problem(root / "data")
    made = init_problem(
        root / "toy", train=[toy / "train.csv"], test=[toy / "test.csv"], inputs=["u"],
        outputs=["y"], sampling_time=0.5, seal=True,
    )  # fmt: skip
    assert made.removed == (toy / "test.csv",)
    (root / "toy" / "baseline.py").write_text(arx(1))
    return root / "toy"


@pytest.fixture
def problem(tmp_path: Path, keys: Path) -> Path:
    return encrypted(tmp_path)


@pytest.fixture(scope="module")
def searched_once(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("encrypted")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ASIA_KEYS", str(root / "keys"))
        go(encrypted(root))
    return root


@pytest.fixture
def searched(searched_once: Path, tmp_path: Path, keys: Path) -> Path:
    """Run directory of a copy of a finished search beside the problem and its key."""
    shutil.copytree(searched_once, tmp_path, dirs_exist_ok=True)
    return tmp_path / "runs" / "toy-scripted-s0"


def go(problem: Path, level: Isolation | None = None, experiments: int = 2) -> Path:
    loaded = load_problem(problem)
    loaded = replace(loaded, budget=replace(loaded.budget, experiments=experiments))
    agent = Scripted((arx(2), arx(3)))
    runs = problem.parent / "runs"
    ready = prepare(loaded, agent.name, seed=0, runs=runs, isolation=level)
    search(ready, agent, lambda event, view: None, lambda view: None)
    return ready.directory


@pytest.mark.slow
def test_the_digest_stands_before_experiment_1_and_the_key_is_not_needed(
    problem: Path, keys: Path
) -> None:
    (key,) = keys.iterdir()
    away = problem.parent / key.name
    key.rename(away)
    directory = go(problem)
    lines = list(read_lines(directory / "ledger.jsonl"))
    first = lines[0].event
    assert isinstance(first, Started)
    head = json.loads((problem / "test.sealed").read_bytes().partition(b"\n")[0])
    assert first.test_digest == head["sha256"]
    assert sum(line.event.event == "proposed" for line in lines) == 2

    # Without the key nothing is opened, and the search has not ended.
    with pytest.raises(UserError, match="is not on this machine"):
        unseal(directory, process_consent=True)
    view = open_run(directory).view
    assert view.unsealing is None
    go(problem, experiments=3)

    result = unseal(directory, process_consent=True, keys=away.parent)
    assert result.record.test_digest == head["sha256"]
    assert result.record.trajectories == ("test",)

    # The bands of the test are artifacts as all others are.
    bands = result.record.bands
    assert bands is not None
    for name in (bands.lower, bands.upper):
        path = directory / "artifacts" / name
        kept = path.read_bytes()
        path.write_bytes(b"x" + kept[1:])
        with pytest.raises(UserError, match="was changed after it was written"):
            verify(directory)
        path.write_bytes(kept)
    verify(directory)


@pytest.mark.slow
def test_a_run_that_does_not_verify_is_not_opened(searched: Path) -> None:
    directory = searched
    view = open_run(directory).view
    assert view.best is not None
    assert view.best.result is not None
    model = directory / "artifacts" / view.best.result.folds[0].model
    model.write_bytes(model.read_bytes() + b" ")
    with pytest.raises(UserError, match="artifact"):
        unseal(directory, process_consent=True)
    assert open_run(directory).view.unsealing is None


@pytest.mark.slow
def test_the_opening_is_on_record_before_its_result_and_ends_the_search(
    searched: Path, tmp_path: Path
) -> None:
    directory = searched
    unseal(directory, process_consent=True)
    last = [line.event for line in read_lines(directory / "ledger.jsonl")][-2:]
    assert [type(event) for event in last] == [Unsealing, Unsealed]
    with pytest.raises(UserError, match="was unsealed"):
        go(tmp_path / "toy", experiments=3)
    assert not unseal(directory).first_time
    assert len(list(read_lines(directory / "ledger.jsonl"))) == len(open_run(directory).lines)
    verify(directory)


@pytest.mark.slow
def test_a_kill_while_the_test_is_open_loses_nothing_and_opens_it_once(
    searched: Path, tmp_path: Path
) -> None:
    directory = searched
    result = unseal(directory, process_consent=True).record
    ledger = directory / "ledger.jsonl"
    lines = ledger.read_bytes().splitlines(keepends=True)
    ledger.write_bytes(b"".join(lines[:-1]))
    with pytest.raises(UserError, match="was unsealed"):
        go(tmp_path / "toy", experiments=3)
    again = unseal(directory)
    assert again.record == result
    events = [line.event.event for line in read_lines(ledger)]
    assert events.count("unsealing") == events.count("unsealed") == 1
    verify(directory)


@pytest.mark.slow
def test_no_test_value_lies_in_a_run_before_it_is_opened(searched: Path, tmp_path: Path) -> None:
    from asia.problem.seal import open_test

    (record,) = open_test(load_problem(tmp_path / "toy"))
    shown = record.y[40:43].tobytes(), repr(float(record.y[40, 0])).encode()
    for path in searched.rglob("*"):
        if path.is_file():
            data = path.read_bytes()
            assert not any(value in data for value in shown), path


@pytest.mark.slow
def test_level_process_asks_for_consent_and_records_it(problem: Path) -> None:
    directory = go(problem, Isolation.PROCESS)
    assert needs_consent(open_run(directory).view)
    with pytest.raises(UserError) as caught:
        unseal(directory)
    assert "can read every file that you can" in str(caught.value)
    assert "--yes-process" in str(caught.value)
    assert open_run(directory).view.unsealing is None
    assert unseal(directory, process_consent=True).first_time
    unsealing = open_run(directory).view.unsealing
    assert unsealing is not None
    assert unsealing.process_consent


@pytest.mark.slow
@pytest.mark.skipif(not STRONG, reason="this machine has level process only")
def test_a_stronger_level_asks_for_none_and_records_none(searched: Path) -> None:
    assert unseal(searched, process_consent=True).first_time
    unsealing = open_run(searched).view.unsealing
    assert unsealing is not None
    assert not unsealing.process_consent


@pytest.mark.parametrize("what", ["runs", "train", "keys"])
def test_nothing_hidden_lies_where_candidates_read(
    problem: Path, what: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    loaded = load_problem(problem)
    places = {
        "runs": tmp_path / "runs" / "toy",
        "train": tmp_path / "data",
        "keys": tmp_path / "keys",
    }
    check_run_is_hidden(loaded, places["runs"], Isolation.LANDLOCK)
    monkeypatch.setattr("sys.prefix", str(places[what]))
    with pytest.raises(UserError, match="which every candidate can read"):
        check_run_is_hidden(loaded, places["runs"], Isolation.LANDLOCK)
    check_run_is_hidden(loaded, places["runs"], Isolation.PROCESS)


def test_no_mount_shows_an_agent_the_test_or_its_key(tmp_path: Path, problem: Path) -> None:
    encrypted, plain = load_problem(problem), load_problem(write_problem(tmp_path / "plain"))
    check_hidden_from_agent([tmp_path / "data"], encrypted)
    for shown, loaded in (
        (tmp_path, encrypted),
        (tmp_path / "keys", encrypted),
        (tmp_path / "plain", plain),
        (tmp_path / "plain" / "test.csv", plain),
    ):
        with pytest.raises(UserError, match="would show the agent"):
            check_hidden_from_agent([shown], loaded)


def test_rules_of_a_command_agent_are_checked_for_it(tmp_path: Path) -> None:
    from tests.unit.interfaces.workspace.commands import fake, run_command

    toy = write_problem(tmp_path / "toy")
    ready = prepare(load_problem(toy), "claude", seed=0, runs=tmp_path / "elsewhere" / "runs")
    rules = CommandRules(mounts=(toy,), jail=True)
    with pytest.raises(UserError, match="contains test data or their key"):
        run_command(ready, fake("claude", "search"), rules)
