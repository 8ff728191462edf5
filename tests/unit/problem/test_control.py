"""[control]: scenarios, folds, lock, and refusals."""

import hashlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import asia
from asia.errors import UserError
from asia.problem.folds import make_folds
from asia.problem.load import load_lock, load_problem
from asia.problem.lock import lock_text
from asia.problem.seal import open_guard, open_test, seal
from tests.unit.problem.small_control import PROBLEM, write_control_problem


def test_scenarios_are_records_from_outside_signals_to_targets(tmp_path: Path) -> None:
    problem = load_problem(write_control_problem(tmp_path))
    assert [s.name for s in problem.inputs] == ["y_setpoint", "load", "y_noise", "gain"]
    assert [s.name for s in problem.outputs] == ["y", "u_change"]
    for record in problem.train:
        assert np.array_equal(record.y[:, 0], record.u[:, 0])
        assert not record.y[:, 1].any()
        assert 1.9 <= record.u[0, 3] <= 2.1
        assert np.ptp(record.u[:, 3]) == 0
    first, second = problem.train
    assert not np.array_equal(first.u, second.u)
    # A fold holds out whole scenarios, and errors count in tolerances.
    for fold in make_folds(problem.train, problem.protocol):
        held = {block.name for block in fold.held_out}
        assert held.isdisjoint(r.name for r in fold.train)
        assert fold.scale.tolist() == [0.2, pytest.approx(0.3)]


def test_only_the_plants_of_asia_run_without_a_sandbox(tmp_path: Path) -> None:
    found = load_problem("two_tanks_control").control
    assert found is not None
    assert found.plant.is_built_in
    write_control_problem(tmp_path)
    folder = Path(asia.__file__).parent / "problems"
    # A path through the folder of the built-in problems, and out of it again.
    way = folder / ("../" * len(folder.parts)) / tmp_path.relative_to("/") / "plant.py"
    assert way.is_file()
    text = PROBLEM.replace('"plant.py:step"', f'"{way}:step"')
    found = load_problem(write_control_problem(tmp_path, text)).control
    assert found is not None
    assert not found.plant.is_built_in


def test_the_sealed_scenarios_are_others(tmp_path: Path) -> None:
    problem = load_problem(write_control_problem(tmp_path))
    (test,) = open_test(problem)
    assert seal(problem).shared_samples == 0
    assert all(not np.array_equal(test.u, record.u) for record in problem.train)


def test_guard_scenarios_are_drawn_where_they_are_asked_for_and_none_is_declared(
    tmp_path: Path,
) -> None:
    folder = write_control_problem(tmp_path / "lag")
    assert load_problem(folder).guard_names == ()
    held = load_problem(folder, 0.15)
    assert held.guard_names == ("guard1",)
    (guard,) = open_guard(held)
    for record in (*held.train, *open_test(held)):
        assert not np.array_equal(guard.u, record.u)
    (folder / "problem.toml").write_text(PROBLEM.replace("test = 1\n", "test = 1\nguard = 2\n"))
    assert len(load_problem(folder, 0.15).guard_names) == 2


def test_the_lock_restores_the_problem(tmp_path: Path) -> None:
    problem = load_problem(write_control_problem(tmp_path / "lag"))
    assert problem.control is not None
    problem = replace(problem, control=replace(problem.control, models=(b"a model",)))
    assert problem.control is not None
    run = tmp_path / "run"
    (run / "artifacts").mkdir(parents=True)
    lock = run / "problem.lock.toml"
    lock.write_text(lock_text(problem, seal(problem)), "utf-8")
    # A ledger without artifacts has no models.
    found = load_lock(lock)
    assert found.control is not None
    assert found.control.models == ()
    (run / "artifacts" / hashlib.sha256(b"a model").hexdigest()).write_bytes(b"a model")
    found = load_lock(lock)
    assert found.control is not None
    assert found.control.models == (b"a model",)
    assert found.protocol == problem.protocol
    assert [r.u.tolist() for r in found.train] == [r.u.tolist() for r in problem.train]


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('kind = "control"', 'kind = "simulation"', "belong together"),
        ("[control.noise]\ny", "[control.noise]\nz", "no signal 'z'"),
        ("[control.tolerance]\ny = 0.2", "[control.tolerance]\nu = 0.2", "leaves out 'y'"),
        ("[control.tolerance]\ny = 0.2", "[control.tolerance]\ny = 0.0", "a positive number"),
        ("start = 1.0", "start = 4.0", "start between them"),
        ("train = 2\nfolds = 2", "train = 2\nfolds = 3", "2 training scenarios for 3 folds"),
        ("load = {", "y_noise = {", "two signals are called 'y_noise'"),
        ("min = 1.0, max = 4.0", "min = 4.0, max = 1.0", "min is above max"),
    ],
)
def test_tables_that_do_not_fit_are_refused(tmp_path: Path, old: str, new: str, said: str) -> None:
    assert old in PROBLEM
    write_control_problem(tmp_path, PROBLEM.replace(old, new))
    with pytest.raises(UserError, match=said):
        load_problem(tmp_path)
