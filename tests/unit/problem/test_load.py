from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from asia.data import Signal
from asia.errors import UserError
from asia.problem.load import builtin_problems, load_problem

Write = Callable[..., Path]

PHYSICS = """
[physics]
states = ["x"]
[physics.parameters]
a = { min = 1e-3, max = 1.0 }
[physics.dynamics]
x = "-a*x + u"
[physics.observation]
y = "x"
"""


def message(path: Path) -> str:
    with pytest.raises(UserError) as caught:
        load_problem(path)
    text = str(caught.value)
    assert "\n" not in text
    return text


def test_minimal_file_is_enough(write_problem: Write) -> None:
    directory = write_problem()
    problem = load_problem(directory)
    assert problem.name == "problem"
    assert problem.inputs == (Signal("u"),)
    assert problem.description == ""
    assert problem.baseline is None
    assert problem.warnings == ()
    assert [len(t) for t in problem.train] == [120]
    assert problem.train[0].sampling_time == 0.1
    assert load_problem(directory / "problem.toml").train[0].name == "train"


def test_texts_next_to_the_file_are_found(write_problem: Write, minimal: str) -> None:
    directory = write_problem('name = "x"\ndescription = "d.md"\n' + minimal + PHYSICS)
    (directory / "d.md").write_text("a tank")
    (directory / "baseline.py").write_text("pass\n")
    problem = load_problem(directory)
    assert (problem.name, problem.description, problem.baseline) == ("x", "a tank", "pass\n")
    assert problem.physics is not None
    assert problem.physics.dynamics == {"x": "-a*x + u"}


def test_simulated_problem_loads_by_name() -> None:
    problem = load_problem("two_tanks_sim")
    again = load_problem("two_tanks_sim")
    assert problem.truth is not None
    assert np.array_equal(problem.train[0].y, again.train[0].y)
    error = problem.train[0].y - problem.truth[0]
    assert 0.045 < error.std() < 0.055
    assert problem.truth[0].max() == 10.0
    assert problem.physics is not None
    assert problem.description.startswith("# Two tanks")
    assert set(builtin_problems()) >= {"two_tanks_sim", "cascaded_tanks"}


@pytest.mark.data
@pytest.mark.skipif(not os.environ.get("ASIA_DATA_DIR"), reason="ASIA_DATA_DIR is not set")
def test_cascaded_tanks_load_by_name() -> None:
    problem = load_problem("cascaded_tanks")
    assert [t.y.shape for t in problem.train] == [(1024, 1)]
    assert problem.train[0].u[0, 0] == pytest.approx(3.2567, abs=1e-3)
    assert problem.protocol.test.skip == 45
    assert problem.protocol.past == 5


@pytest.fixture
def flights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A clone of the nanodrone repository with made-up flights, more columns than needed."""
    monkeypatch.setenv("ASIA_DATA_DIR", str(tmp_path))
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    motors, outputs = "m1_rads,m2_rads,m3_rads,m4_rads", "x,y,z,vx,vy,vz,roll,pitch,yaw,wx,wy,wz"
    header = f"t,more,{motors},{outputs}"
    random = np.random.default_rng(0)
    clone = tmp_path / "nanodrone-sysid-benchmark"
    for part, kinds, count in (
        ("train", ("chirp", "random", "square"), 4),
        ("test", ("melon",), 3),
    ):
        (clone / "data" / part).mkdir(parents=True)
        for kind in kinds:
            for run in range(1, count + 1):
                path = clone / "data" / part / f"{kind}_20251017_run{run}.csv"
                rows = random.standard_normal((70 + run, 18))
                rows[:, 0] = 0.01 * np.arange(len(rows))
                np.savetxt(path, rows, delimiter=",", header=header, comments="")
    return clone


def test_nanodrone_loads_from_a_clone_of_its_repository(flights: Path) -> None:
    problem = load_problem("nanodrone")
    assert [t.name for t in problem.train[::4]] == [
        f"{k}_20251017_run1" for k in ("chirp", "random", "square")
    ]
    assert [len(t) for t in problem.train] == [71, 72, 73, 74] * 3
    assert problem.train[0].u.shape[1] == 4
    assert [g.name for g in problem.protocol.folds.groups] == ["chirp", "random", "square"]
    assert problem.physics is not None
    assert problem.physics.states == tuple(s.name for s in problem.outputs)
    assert problem.baseline is not None
    (flights / "data" / "train" / "square_20251017_run4.csv").unlink()
    with pytest.raises(UserError, match=r"square_20251017_run4\.csv is missing"):
        load_problem("nanodrone")


def test_a_clone_without_git_lfs_names_the_remedy(flights: Path) -> None:
    flight = flights / "data" / "train" / "random_20251017_run2.csv"
    flight.write_text("version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1109476\n")
    expected = r"random_20251017_run2\.csv is a pointer of git-lfs .* git lfs pull .*/releases"
    with pytest.raises(UserError, match=expected):
        load_problem("nanodrone")


def test_missing_nanodrone_says_how_to_get_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("ASIA_DATA_DIR", raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    expected = (
        r"git clone https://github\.com/idsia-robotics/nanodrone-sysid-benchmark .*ASIA_DATA_DIR"
    )
    with pytest.raises(UserError, match=expected):
        load_problem("nanodrone")


def test_missing_benchmark_says_which_file_to_put_where(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ASIA_DATA_DIR", str(tmp_path / "none"))
    monkeypatch.setenv("HOME", str(tmp_path))

    def no_network(*_: object, **__: object) -> None:
        raise OSError("network is unreachable")

    monkeypatch.setattr("socket.socket.connect", no_network)
    monkeypatch.setattr("socket.getaddrinfo", no_network)
    with pytest.raises(UserError, match=r"dataBenchmark\.mat is missing.*ASIA_DATA_DIR"):
        load_problem("cascaded_tanks")
    assert not list((tmp_path / ".nonlinear_benchmarks").rglob("*.zip"))


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (("sampling_time", "sampling_tme"), "'sampling_tme' in the top level; did you mean 'samp"),
        (("[data]", "[data]\ntrian = []"), "unknown key 'trian' in [data]; did you mean 'train'?"),
        (
            ("[data]", "[protocol.folds]\ncuont = 3\n[data]"),
            "unknown key 'cuont' in [protocol.folds]; did you mean 'count'?",
        ),
        (("[data]", "[budget]\nmemory_mb = 512\n[data]"), "JAX cannot start under 1600 MB"),
        (("[data]", "[budget]\nhours = 0\n[data]"), "budget.hours is 0, expected a number above 0"),
        (("[data]", "[protocol]\npast_inputs = -1\n[data]"), "is -1, expected at least 0"),
        (("[data]", '[protocol]\npast_inputs = "5"\n[data]'), 'is "5", expected a whole number'),
        (("[data]", '[protocol]\nmetric = "mse"\n[data]'), "is 'mse', expected 'rmse'"),
        (("0.1", "nan"), "expected a finite number"),
        (('inputs = ["u"]', ""), "'inputs' is missing in the top level"),
        (('["u"]', "[]"), "inputs is [], expected at least one entry"),
        (('["u"]', '[{ name = "u", unti = "V" }]'), "in [inputs[0]]; did you mean 'unit'?"),
        (('["y"]', '["u"]'), "signal 'u' is named 2 times"),
        (('["y"]', '["Y1"]'), "has no column 'Y1' (it has t, u, y); did you mean 'y'?"),
        (('["train.csv"]', "[]"), "[data] names no training data"),
        (('["train.csv"]', '["test.csv"]'), "in both train and test"),
        (('["train.csv"]', '["nowhere.csv"]'), "no such file"),
        (('["train.csv"]', '[""]'), "data.train[0] = '' is not a file name"),
        (('["train.csv"]', '["a\\u0000b"]'), "is not a file name"),
        (("[data]", 'description = "d.md"\n[data]'), "no such file"),
        (("[data]", "[data"), "is not valid TOML"),
        (('["u"]', '[""]'), "inputs[0] is a signal without a name"),
        (("0.1", "2026-01-01"), "2026-01-01 is a date or a time"),
        (("[data]", "budget = 3\n[data]"), "budget is 3, expected a table"),
        (('["train.csv"]', '"train.csv"'), 'data.train is "train.csv", expected a list in [ ]'),
    ],
)
def test_bad_file_gives_one_sentence(
    write_problem: Write, minimal: str, change: tuple[str, str], expected: str
) -> None:
    toml = minimal.replace(*change)
    assert toml != minimal
    assert expected in message(write_problem(toml))


@pytest.mark.parametrize(
    ("source", "expected"),
    [
        ('source = "nonlinear_benchmarks:Cascaded_Tank"', "did you mean 'cascaded_tanks'?"),
        ('source = "simulated:tanks"', "did you mean 'two_tanks'?"),
        ('source = "web:x"', "expected 'benchmark:<name>', 'nanodrone'"),
        ('source = "benchmark:silver_box"', "did you mean 'silverbox'?"),
        ('source = "simulated:two_tanks"\ntrain = ["a.csv"]', "keep one of them"),
        ('source = "nonlinear_benchmarks:CED"\nseed = 1', "data.seed belongs to a simulated"),
        ('source = "simulated:two_tanks"', "sampled every 4 s"),
    ],
)
def test_bad_source(write_problem: Write, minimal: str, source: str, expected: str) -> None:
    toml = minimal.split("[data]")[0] + f"[data]\n{source}\n"
    assert expected in message(write_problem(toml))


def test_many_mistakes_are_cut_short(write_problem: Write, minimal: str) -> None:
    extra = "".join(f"wrong{i} = 1\n" for i in range(6))
    assert "and 3 more" in message(write_problem(extra + minimal))


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (("-a*x + u", "-b*x + u"), "undefined symbol 'b'"),
        (("-a*x + u", "open(x)"), "there is no function 'open'"),
        (("max = 1.0", "max = 1.0, step = 2"), "in [physics.parameters.a]"),
        (("max = 1.0", "max = 0.0"), "must be below max"),
    ],
)
def test_bad_physics(
    write_problem: Write, minimal: str, change: tuple[str, str], expected: str
) -> None:
    assert expected in message(write_problem(minimal + PHYSICS.replace(*change)))


def test_too_few_samples_for_the_folds(write_problem: Write) -> None:
    assert "2 folds with a past window of 10 need at least 50" in message(write_problem(samples=49))


def test_just_enough_samples_for_the_folds(write_problem: Write) -> None:
    assert len(load_problem(write_problem(samples=50)).train[0]) == 50


def test_unknown_name_suggests_a_built_in() -> None:
    with pytest.raises(UserError, match="did you mean 'cascaded_tanks'"):
        load_problem("cascaded_tank")


def test_directory_without_problem_file(tmp_path: Path) -> None:
    assert "has no problem.toml" in message(tmp_path)


def test_test_data_are_not_opened(write_problem: Write) -> None:
    directory = write_problem()
    (directory / "test.csv").write_bytes(b"\0 not a record")
    assert len(load_problem(directory).train) == 1


def test_records_with_the_same_file_name_get_distinct_names(
    write_problem: Write, minimal: str, record: Callable[[int, int], str]
) -> None:
    directory = write_problem(minimal.replace('["train.csv"]', '["a/run.csv", "b/run.csv"]'))
    for seed, part in enumerate("ab"):
        (directory / part).mkdir()
        (directory / part / "run.csv").write_text(record(60, seed))
    assert [t.name for t in load_problem(directory).train] == ["a/run", "b/run"]
