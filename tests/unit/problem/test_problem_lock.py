from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from asia.data import Trajectory
from asia.data.trajectory import data_digest
from asia.errors import UserError
from asia.problem import Budget
from asia.problem.load import load_lock, load_problem
from asia.problem.lock import lock_differences, lock_text, protocol_digest
from asia.problem.problem import Problem, Seal
from asia.problem.protocol import FoldRule, ProtocolRule
from asia.problem.toml import toml_text

Write = Callable[..., Path]


@pytest.fixture
def locked(write_problem: Write, minimal: str, tmp_path: Path) -> tuple[Problem, Path]:
    """A problem with everything in it, and its lock in another directory."""
    directory = write_problem(
        minimal.replace('["u"]', '[{ name = "u", unit = "°C" }]')
        + '[protocol]\npast_inputs = 3\n[budget]\nhours = 0.5\n[physics]\nstates = ["x"]\n'
        '[physics.constants]\ng = 9.81\n[physics.dynamics]\nx = "u - g*x + d"\n'
        "[physics.parameters]\na = { min = 0.1, max = 1.0 }\n"
        '[physics.priors]\n"a/g" = { mean = 0.1, deviation = 0.02, reason = "a ruler" }\n'
        "[physics.corrections]\nd = { scale = 0.5 }\n"
        '[physics.observation]\ny = "x"\n[physics.bounds]\nx = { min = 0.0 }\n'
        '[symmetry.odd]\nu = "-u"\ny = "-y"\n'
    )
    (directory / "description.md").write_text("a 'tank' of \"water\"\n\\ tab\t ° \x7f 😀\n")
    (directory / "baseline.py").write_text("def fit(): ...\n")
    problem = load_problem(directory)
    path = tmp_path / "run" / "problem.lock.toml"
    path.parent.mkdir()
    path.write_text(lock_text(problem, Seal("0" * 64, ("test",), (80,))), encoding="utf-8")
    return problem, path


def test_lock_restores_the_problem(locked: tuple[Problem, Path]) -> None:
    problem, path = locked
    again = load_lock(path)
    for part in ("name", "description", "baseline", "inputs", "outputs", "sampling_time"):
        assert getattr(again, part) == getattr(problem, part)
    for part in ("data", "protocol", "budget", "physics", "symmetry"):
        assert getattr(again, part) == getattr(problem, part)
    assert data_digest(again.train) == data_digest(problem.train)
    assert again.test.source == problem.test.source
    assert again.test.sha256 == "0" * 64


def test_lock_of_a_lock_is_the_same(locked: tuple[Problem, Path]) -> None:
    problem, path = locked
    seal = Seal("0" * 64, ("test",), (80,))
    assert lock_text(load_lock(path), seal) == lock_text(problem, seal) == path.read_text("utf-8")
    assert lock_differences(load_lock(path), seal, path) == ()


def test_built_in_problem_round_trip(tmp_path: Path) -> None:
    problem = load_problem("two_tanks_sim")
    path = tmp_path / "problem.lock.toml"
    path.write_text(lock_text(problem, Seal(None)), encoding="utf-8")
    again = load_lock(path)
    assert again.truth is not None
    assert lock_text(again, Seal(None)) == path.read_text("utf-8")


def test_changed_training_record_is_named(locked: tuple[Problem, Path]) -> None:
    problem, path = locked
    csv = problem.data.train[0]  # type: ignore[attr-defined]
    csv.write_text(csv.read_text().replace("0.0,", "0.0,1", 1))
    with pytest.raises(UserError, match="training record 'train' changed"):
        load_lock(path)


def test_missing_training_record_is_named(locked: tuple[Problem, Path]) -> None:
    problem, path = locked
    problem.data.train[0].unlink()  # type: ignore[attr-defined]
    with pytest.raises(UserError, match=r"no such file.*train\.csv"):
        load_lock(path)


@pytest.mark.parametrize(
    ("change", "part"),
    [
        (("past_inputs = 3", "past_inputs = 4"), "the protocol"),
        (("u - g*x", "u - 2*g*x"), "the physics"),
        (("a 'tank'", "a 'tonk'"), "the description"),
        (("def fit()", "def fat()"), "the baseline"),
        (("baseline =", "# baseline ="), "the baseline"),
    ],
)
def test_edited_lock_is_refused(
    locked: tuple[Problem, Path], change: tuple[str, str], part: str
) -> None:
    _, path = locked
    text = path.read_text("utf-8")
    assert change[0] in text
    path.write_text(text.replace(*change, 1), encoding="utf-8")
    with pytest.raises(UserError, match=f"{part} changed since the run began"):
        load_lock(path)


def test_moved_problem_finds_its_texts_in_the_lock(locked: tuple[Problem, Path]) -> None:
    problem, path = locked
    directory = problem.data.train[0].parent  # type: ignore[attr-defined]
    (directory / "problem.toml").unlink()
    (directory / "description.md").unlink()
    assert load_lock(path).description == problem.description


def test_differences_are_listed(locked: tuple[Problem, Path]) -> None:
    problem, path = locked
    other = replace(
        problem,
        description="other",
        budget=replace(problem.budget, experiments=99),
        protocol=replace(problem.protocol, past_inputs=4),
        train=(problem.train[0][:100],),
    )
    found = [str(d) for d in lock_differences(other, Seal(None), path)]
    assert "budget.experiments was 15, is 99" in found
    assert "protocol.past_inputs was 3, is 4" in found
    assert {"train changed", "test changed", "description changed", "protocol changed"} <= {*found}
    assert len(found) == 6


def test_digests_depend_on_every_value() -> None:
    t = Trajectory([[1.0], [2.0]], [[3.0], [4.0]], 0.1, "a")  # type: ignore[arg-type]
    others = [
        replace(t, u=t.u[::-1]),
        replace(t, y=t.u, u=t.y),
        replace(t, sampling_time=0.2),
        t[:1],
    ]
    digests = {data_digest([x]) for x in (t, *others)} | {data_digest([t, t])}
    assert len(digests) == 6
    assert data_digest([replace(t, name="b")]) == data_digest([t])


def test_protocol_digest_ignores_the_budget() -> None:
    problem = load_problem("two_tanks_sim")
    richer = replace(problem, budget=Budget(experiments=99))
    stricter = replace(problem, protocol=ProtocolRule(folds=FoldRule(count=3)))
    assert protocol_digest(problem) == protocol_digest(richer)
    assert protocol_digest(problem) != protocol_digest(stricter)


scalars = st.text() | st.integers(-(2**63), 2**63 - 1) | st.booleans() | st.floats(allow_nan=False)
tables = st.recursive(
    st.dictionaries(st.text(), scalars | st.lists(st.text()), max_size=4),
    lambda inner: st.dictionaries(st.text(), scalars | inner, max_size=4),
    max_leaves=8,
)


@settings(max_examples=50, deadline=None)
@given(tables)
def test_toml_text_reads_back(table: dict[str, object]) -> None:
    import tomllib

    assert tomllib.loads(toml_text(table)) == table
