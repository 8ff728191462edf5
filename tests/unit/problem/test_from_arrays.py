"""Problems from arrays in memory: what is written, what is refused, and a whole search on one."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import asia
from asia.data import Signal, data_digest
from asia.errors import UserError
from asia.ledger.verification import verify
from asia.problem import Budget, ParameterRange, Physics, Prior
from asia.problem.problem import Problem
from asia.problem.protocol import FoldRule, ProtocolRule
from asia.problem.seal import open_test
from tests.unit.search.toy import arx


class Frame:
    """Minimal interface shared by data frames of different packages."""

    def __init__(self, columns: Sequence[str], values: np.ndarray) -> None:
        self.columns, self._values, self.shape = list(columns), values, values.shape

    def to_numpy(self) -> np.ndarray:
        return self._values


def record(samples: int, seed: int, inputs: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """A first-order system with noise."""
    random = np.random.default_rng(seed)
    u = np.repeat(random.standard_normal((samples // 5 + 1, inputs)), 5, axis=0)[:samples]
    y = np.zeros((samples, 1))
    for k in range(1, samples):
        y[k] = 0.8 * y[k - 1] + 0.2 * u[k - 1].sum()
    return u, y + 0.01 * random.standard_normal(y.shape)


def make(directory: Path, **changes: Any) -> Problem:
    (u, y), (test_u, test_y) = record(120, 0), record(90, 1)
    arguments = {"sampling_time": 0.5, "test_u": test_u, "test_y": test_y, **changes}
    return Problem.from_arrays(
        arguments.pop("u", u), arguments.pop("y", y), directory=directory, **arguments
    )


def test_every_number_comes_back(tmp_path: Path) -> None:
    problem = make(tmp_path / "mine")
    (u, y), (test_u, test_y) = record(120, 0), record(90, 1)
    assert np.array_equal(problem.train[0].u, u)
    assert np.array_equal(problem.train[0].y, y)
    assert problem.name == "mine"
    assert [s.name for s in (*problem.inputs, *problem.outputs)] == ["u", "y"]
    (test,) = open_test(problem)
    assert np.array_equal(test.u, test_u)
    assert np.array_equal(test.y, test_y)
    assert sorted(p.name for p in (tmp_path / "mine").iterdir()) == [
        "problem.toml", "test1.csv", "train1.csv",
    ]  # fmt: skip


def test_several_records_with_everything_named(tmp_path: Path) -> None:
    records = [record(120, seed, inputs=2) for seed in range(3)]
    problem = Problem.from_arrays(
        [u for u, _ in records],
        [y[:, 0] for _, y in records],
        sampling_time=np.float64(0.5),
        directory=str(tmp_path / "mine"),
        inputs=["flow", Signal("valve, main", "%")],
        outputs=[Signal("level", "m")],
        name="tank",
        description="A tank.\n",
        baseline="def fit(): ...\n",
        groups={"slow": ["train1"], "fast": ["train[23]"]},
        protocol={"folds": {"kind": "leave_one_group_out"}, "past_inputs": np.int64(3)},
        budget=Budget(experiments=3),
        physics=Physics(
            ("level",),
            {"level": "k*flow"},
            parameters={"k": ParameterRange(0.1, 1.0)},
            priors={"2*k": Prior(1.0, 0.2, "a data sheet")},
        ),
        symmetry={"odd": {"flow": "-flow", "level": "-level"}},
    )
    assert [t.name for t in problem.train] == ["train1", "train2", "train3"]
    assert problem.inputs[1] == Signal("valve, main", "%")
    assert np.array_equal(problem.train[2].u, records[2][0])
    assert [g.records for g in problem.protocol.folds.groups] == [("train1",), ("train2", "train3")]
    assert (problem.protocol.past_inputs, problem.budget.experiments) == (3, 3)
    assert problem.physics is not None
    assert problem.physics.parameters["k"].max == 1.0
    assert problem.physics.priors["2*k"] == Prior(1.0, 0.2, "a data sheet")
    assert problem.symmetry == {"odd": {"flow": "-flow", "level": "-level"}}
    assert (problem.name, problem.description, problem.baseline) == (
        "tank",
        "A tank.\n",
        "def fit(): ...\n",
    )
    assert problem.test.source is None


def test_data_frames_give_their_columns(tmp_path: Path) -> None:
    u, y = record(120, 0)
    whole = Frame(["t", "u", "y"], np.concatenate([np.arange(120.0)[:, None], u, y], axis=1))
    chosen = Problem.from_arrays(
        whole, whole, sampling_time=0.5, directory=tmp_path / "a", inputs=["u"], outputs=["y"]
    )
    named = Problem.from_arrays(
        [Frame(["flow"], u)], [Frame(["level"], y)], sampling_time=0.5, directory=tmp_path / "b"
    )
    assert data_digest(chosen.train) == data_digest(named.train)
    assert [s.name for s in (*named.inputs, *named.outputs)] == ["flow", "level"]
    with pytest.raises(UserError, match=r"no column 'uu' .*did you mean 'u'"):
        Problem.from_arrays(
            whole, whole, sampling_time=0.5, directory=tmp_path / "c", inputs=["uu"], outputs=["y"]
        )


def test_columns_with_units_give_names_and_units(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    frames = [Frame([c], rng.normal(size=(80, 1))) for c in ("valve [%]", "level (m)")]
    problem = Problem.from_arrays(*frames, sampling_time=0.1, directory=tmp_path / "p")
    assert problem.inputs == (Signal("valve", "%"),)
    assert problem.outputs == (Signal("level", "m"),)
    twins = Frame(["T (1)", "T (2)"], rng.normal(size=(80, 2)))
    problem = Problem.from_arrays(twins, frames[1], sampling_time=0.1, directory=tmp_path / "q")
    assert [s.name for s in problem.inputs] == ["T (1)", "T (2)"]


def test_the_same_again_is_loaded_and_other_data_are_refused(tmp_path: Path) -> None:
    first = make(tmp_path / "mine")
    before = {p: p.stat().st_mtime_ns for p in (tmp_path / "mine").iterdir()}
    assert data_digest(make(tmp_path / "mine").train) == data_digest(first.train)
    other = record(120, 7)
    for changes, what in (
        ({"u": other[0], "y": other[1]}, "train1.csv"),
        ({"protocol": ProtocolRule(folds=FoldRule(count=3))}, "problem.toml"),
    ):
        with pytest.raises(UserError, match=rf"holds another problem \({what} differs\)"):
            make(tmp_path / "mine", **changes)
    assert {p: p.stat().st_mtime_ns for p in (tmp_path / "mine").iterdir()} == before


def test_a_directory_with_other_files_is_not_changed(tmp_path: Path) -> None:
    (tmp_path / "note.txt").write_text("mine")
    with pytest.raises(UserError, match="is not empty"):
        make(tmp_path)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"y": [record(120, 0)[1]] * 2}, "1 arrays of inputs, but 2 of outputs to train"),
        ({"test_y": None}, "1 arrays of inputs, but 0 of outputs to test"),
        ({"u": np.zeros((2, 60, 1))}, "list of arrays for several records"),
        ({"u": np.zeros((90, 1))}, "both need the same length"),
        ({"u": np.full((120, 1), np.inf)}, "the value at sample 1, channel 1 is infinite"),
        ({"u": np.array(["a"] * 120)}, "cannot be converted to numbers"),
        ({"inputs": ["a", "b"]}, "1 channels, but 2 are named"),
        ({"inputs": ["y"]}, "signal 'y' is named 2 times"),
        ({"protocol": {"metrik": "rmse"}}, r"unknown key 'metrik' in \[protocol\]; did you mean"),
        ({"budget": {"memory_mb": 1}}, "JAX cannot start"),
    ],
)
def test_invalid_problems_are_refused(
    tmp_path: Path, changes: dict[str, Any], expected: str
) -> None:
    with pytest.raises(UserError, match=expected):
        make(tmp_path / "mine", **changes)
    assert not (tmp_path / "mine").exists()


@pytest.mark.slow
def test_a_search_on_arrays_resumes_verifies_and_unseals(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("asia.judge.evaluation.references.LINEAR", arx(2))
    runs = tmp_path / "runs"
    for experiments in (1, 2):
        problem = make(tmp_path / "mine", baseline=arx(1), protocol={"past_inputs": 3})
        run = asia.run(problem, experiments=experiments, runs=runs, name="first")
        assert len(run.view.finished) == experiments
    assert verify(runs / "first").torn == 0
    found = asia.unseal(runs / "first", process_consent=True)
    assert found.first_time
