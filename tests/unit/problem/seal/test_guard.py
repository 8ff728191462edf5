"""Guard records, and errors for wrong names."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from asia.data import Signal, Trajectory
from asia.data.sources import Channels, DataSet, DataTable, Source, SourceData, Subset
from asia.data.sources.files import RecordFiles
from asia.data.sources.nanodrone import Nanodrone
from asia.data.sources.simulated.source import Simulated
from asia.errors import UserError
from asia.problem.check import check_problem
from asia.problem.load import load_lock, load_problem
from asia.problem.lock import lock_text
from asia.problem.seal import guard_digest, open_guard, seal
from tests.unit.search.toy import write_problem

RECORDS = [Trajectory(np.arange(5.0), np.arange(5.0), 1.0, name) for name in ("a", "b")]
ROOT = Path("/somewhere")
CHANNELS = Channels((Signal("u"),), (Signal("y"),), 1.0)


def guarded(tmp_path: Path, line: str) -> Path:
    problem = write_problem(tmp_path / "toy")
    path = problem / "problem.toml"
    path.write_text(path.read_text().replace("[data]\n", f"[data]\n{line}\n"))
    return problem


def test_simulated_guards_are_records_of_their_own() -> None:
    problem = load_problem("two_tanks_sim")
    assert guard_digest(problem) is None
    problem = replace(problem, data=Simulated(3, guard=2))
    first, second = open_guard(problem)
    outputs = [first.y, second.y, problem.train[0].y]
    assert len({y.tobytes() for y in outputs}) == 3
    assert first.name == "two_tanks_guard1"


class Two(DataSet):
    """Two records to train on."""

    def load(self, subset: Subset, channels: Channels) -> SourceData:
        return SourceData(tuple(RECORDS))

    def places(self, subset: Subset) -> tuple[Path, ...]:
        return ()


def test_a_data_sets_guard_trains_nothing() -> None:
    source = Two("two", ("b",))
    assert [t.name for t in source.records("train", CHANNELS).trajectories] == ["a"]
    assert [t.name for t in source.records("guard", CHANNELS).trajectories] == ["b"]


@pytest.mark.parametrize(
    ("table", "source", "words"),
    [
        (DataTable(guard=("a",), source="simulated:two_tanks"), Simulated, "say how many"),
        (DataTable(guard=2, source="nanodrone"), Nanodrone, "name the training records"),
        (DataTable(guard=2, train=("a.csv",)), RecordFiles, "name the files"),
    ],
)
def test_settings_that_do_not_fit_the_source_are_refused(
    table: DataTable, source: type[Source], words: str
) -> None:
    with pytest.raises(UserError, match=words):
        source.from_table(table, ROOT)


def test_names_that_are_not_there_and_too_many() -> None:
    with pytest.raises(UserError, match=r"called 'bb'.*'b'"):
        Two("two", ("bb",)).records("train", CHANNELS)
    with pytest.raises(UserError, match="leave some"):
        Two("two", ("a", "b")).records("train", CHANNELS)


def test_a_guard_that_trains_or_tests_too_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="both train and guard"):
        load_problem(guarded(tmp_path / "1", 'guard = ["train.csv"]'))
    with pytest.raises(UserError, match="both test and guard"):
        load_problem(guarded(tmp_path / "2", 'guard = ["test.csv"]'))
    problem = guarded(tmp_path / "3", 'guard = ["copy.csv"]')
    (problem / "copy.csv").write_text((problem / "train.csv").read_text())
    with pytest.raises(UserError, match="is training record 'train'"):
        guard_digest(load_problem(problem))


def test_a_guard_too_short_for_a_case_is_refused(tmp_path: Path) -> None:
    problem = guarded(tmp_path, 'guard = ["short.csv"]')
    (problem / "short.csv").write_text("u,y\n1,2\n2,3\n")
    with pytest.raises(UserError, match=r"2 samples.*need 4"):
        guard_digest(load_problem(problem))


@pytest.mark.parametrize("line", ["guard = 0", 'guard = "run.csv"', "guard = [1]", "guard = true"])
def test_other_values_are_refused(tmp_path: Path, line: str) -> None:
    with pytest.raises(UserError, match="guard"):
        load_problem(guarded(tmp_path, line))


def test_the_lock_restores_it_and_notices_a_change(tmp_path: Path) -> None:
    folder = guarded(tmp_path, 'guard = ["kept.csv"]')
    (folder / "kept.csv").write_text((folder / "test.csv").read_text().replace("1.", "2.", 1))
    problem = load_problem(folder)
    (tmp_path / "problem.lock.toml").write_text(
        lock_text(problem, replace(seal(problem), guard=guard_digest(problem)))
    )
    locked = load_lock(tmp_path / "problem.lock.toml")
    assert locked.data == problem.data
    assert open_guard(locked)[0].name == "kept"
    lines = check_problem(problem, seal(problem)).lines()
    assert "guard: kept; seen by no fold and no agent, looked at when the search ends" in lines
    (folder / "kept.csv").write_text((folder / "test.csv").read_text())
    with pytest.raises(UserError, match=r"guard records .* changed"):
        open_guard(locked)
