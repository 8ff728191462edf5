"""Guard records that are cut from the training records."""

from pathlib import Path

import numpy as np
import pytest

from asia.data.preprocess import Preprocess
from asia.data.trajectory import Trajectory
from asia.interfaces.workspace.process import SearchRequest, guard_words, with_guard
from asia.problem.held_back import divided
from asia.problem.load import load_lock, load_problem
from asia.problem.lock import lock_text
from asia.problem.protocol import FoldRule, ProtocolRule
from asia.problem.seal import guard_digest, open_guard, seal

RULE = ProtocolRule("simulation", FoldRule(count=2), 4, 4)


def record(length: int, name: str = "r") -> Trajectory:
    time = np.arange(float(length))
    return Trajectory(time, np.sin(time), 1.0, name)


def test_the_end_of_each_of_a_few_records_is_held_back():
    records = [record(100), record(40), record(20)]
    division = divided(records, 0.15, RULE, Preprocess())
    # The end of the shortest cannot hold a past window.
    assert division.lengths == (85, 34, 20)
    assert [len(r) for r in division.train(records)] == [85, 34, 20]
    (first, second) = division.guard(records)
    assert first.u[0, 0] == 85.0
    assert second.u[0, 0] == 34.0


def test_the_last_of_many_records_are_held_back_whole():
    records = [record(30 + k, f"r{k}") for k in range(14)]
    division = divided(records, 0.15, RULE, Preprocess())
    assert [r.name for r in division.guard(records)] == ["r12", "r13"]
    assert [r.name for r in division.train(records)] == [f"r{k}" for k in range(12)]


def test_an_unmeasured_output_is_not_filled_across_the_cut():
    missing = np.zeros((100, 1), bool)
    missing[84:87] = True
    y = np.where(missing[:, 0], np.nan, np.arange(100.0))
    whole = Trajectory(np.arange(100.0), y, 1.0, "r")
    division = divided([whole], 0.15, RULE, Preprocess())
    (kept,) = division.train([whole])
    assert kept.y[-1, 0] == 83.0


def write(folder: Path, samples: int = 200) -> Path:
    rng = np.random.default_rng(1)
    folder.mkdir()
    u = rng.normal(size=samples)
    y = np.convolve(u, 0.5 ** np.arange(9))[:samples] + 0.1 * rng.normal(size=samples)
    table = np.column_stack([u, y])
    np.savetxt(folder / "a.csv", table, delimiter=",", header="u,y", comments="")
    (folder / "problem.toml").write_text(
        'name = "cut"\nsampling_time = 1.0\ninputs = ["u"]\noutputs = ["y"]\n'
        '[data]\ntrain = ["a.csv"]\n[protocol]\npast_inputs = 2\npast_outputs = 2\n'
    )
    return folder


def test_a_lock_restores_the_division(tmp_path: Path):
    folder = write(tmp_path / "cut")
    problem = load_problem(folder, 0.15)
    assert len(problem.train[0]) == 170
    assert problem.guard_names == ("15 % of the training data",)
    sealed = seal(problem)
    lock = tmp_path / "problem.lock.toml"
    text = lock_text(problem, sealed)
    assert "guard_share = 0.15" in text
    lock.write_text(text)
    again = load_lock(lock)
    assert len(again.train[0]) == 170
    assert guard_digest(again) == guard_digest(problem)
    (guard,) = open_guard(again)
    assert len(guard) == 30
    assert not np.isin(guard.u, again.train[0].u).any()


def test_records_that_are_too_short_are_not_cut(tmp_path: Path):
    problem = load_problem(write(tmp_path / "cut", 40), 0.05)
    assert problem.guard_names == ()
    assert len(problem.train[0]) == 40


def test_a_simulated_system_makes_a_fresh_record():
    plain, guarded = (load_problem("two_tanks_sim", share) for share in (None, 0.15))
    assert len(guarded.train[0]) == len(plain.train[0])
    assert guarded.guard_names == ("two_tanks_guard1",)


@pytest.mark.parametrize(("wanted", "share"), [(None, 0.15), (True, 0.15), (False, None)])
def test_a_workspace_holds_some_back_unless_told_not_to(tmp_path: Path, wanted, share):
    folder = write(tmp_path / "cut")
    plain = SearchRequest(problem=str(folder), agent="workspace", experiments=3)
    request = with_guard(plain, wanted, tmp_path / "runs", None)
    assert request.guard == share
    words = guard_words(load_problem(folder, request.guard), request)
    assert ("--no-guard" in words) == (share is not None)
