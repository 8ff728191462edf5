"""Questions of `asia init` on a terminal, and values that it takes without a question."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from asia.data.intake.conversion import record_files, split_names, survey
from asia.data.intake.sheet import Wanted
from asia.problem.load import load_problem
from tests.unit.interfaces.cli.conftest import Asia, Terminal


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("ASIA_KEYS", str(tmp_path / "keys"))
    return tmp_path


def write(name: str, header: str, columns: int) -> None:
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(200, columns))
    if header.startswith("time"):
        rows[:, 0] = 0.5 * np.arange(200)
    np.savetxt(name, rows, delimiter=",", header=header, comments="")


def answer(monkeypatch: pytest.MonkeyPatch, *lines: str) -> Terminal:
    person = Terminal(*lines)
    monkeypatch.setattr("sys.stdin", person)
    return person


def test_names_of_columns_are_split_at_commas(asia: Asia) -> None:
    rng = np.random.default_rng(0)
    rows = np.column_stack([0.5 * np.arange(200), rng.normal(size=(200, 2))])
    np.savetxt("log.csv", rows, delimiter=",")
    names = ("--columns", "t,valve,level", "--inputs", "valve", "--outputs", "level")
    done = asia("init", "made", "--train", "log.csv", *names, "--no-seal")
    assert done.code == 0, done.err
    (record,) = load_problem(Path("made")).train
    assert np.array_equal(record.y[:, 0], rows[:, 2])


def test_a_record_too_short_for_a_sealed_test_is_named(asia: Asia) -> None:
    write("log.csv", "time,u,y", 3)
    lines = Path("log.csv").read_text().split("\n")
    Path("log.csv").write_text("\n".join(lines[:11]))
    done = asia("init", "made", "--train", "log.csv", "--yes")
    assert done.code == 2
    assert "record 'log' has 10 samples, but 2 folds and a sealed test of the last 20%" in done.err
    assert "or use --no-seal, which needs 50" in done.err


def test_the_defaults_are_what_was_found(asia: Asia, monkeypatch: pytest.MonkeyPatch) -> None:
    write("run1.csv", "time,u1,u2 [V],y [m]", 4)
    write("run2.csv", "time,u1,u2 [V],y [m]", 4)
    write("run_test.csv", "time,u1,u2 [V],y [m]", 4)
    person = answer(monkeypatch, "", "", "", "")
    done = asia("init", "mill")
    assert done.code == 0, done.err
    assert person.answers == []
    problem = load_problem("mill")
    assert [s.name for s in problem.inputs] == ["u1", "u2"]
    assert [s.name for s in problem.outputs] == ["y"]
    assert len(problem.train) == 2
    assert problem.sampling_time == pytest.approx(0.5)
    assert problem.test is not None
    assert "run_test" in (Path("mill") / "problem.toml").read_text()


def test_a_wrong_answer_is_asked_again(asia: Asia, monkeypatch: pytest.MonkeyPatch) -> None:
    write("log.csv", "pump speed,valve,level", 3)
    person = answer(monkeypatch, "log.csv", "none", "pump", "pump speed", "level", "-1", "0.5", "n")
    done = asia("init", "mill")
    assert done.code == 0, done.err
    assert person.answers == []
    assert "no column 'pump'; there are pump speed, valve, level" in done.out
    problem = load_problem("mill")
    assert [s.name for s in problem.inputs] == ["pump speed"]
    assert problem.sampling_time == 0.5


def test_test_files_are_asked_for(asia: Asia, monkeypatch: pytest.MonkeyPatch) -> None:
    write("monday.csv", "time,u,y", 3)
    write("tuesday.csv", "time,u,y", 3)
    person = answer(monkeypatch, "nowhere.csv", "tuesday.csv", "", "")
    done = asia("init", "mill", "--train", "monday.csv")
    assert done.code == 0, done.err
    assert person.answers == []
    assert "no such file: nowhere.csv" in done.out
    assert 'test = ["../tuesday.csv"]' in (Path("mill") / "problem.toml").read_text()


def test_experiments_of_one_file_are_offered_as_the_test(
    asia: Asia, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(0)
    rows = [f"{r},{0.5 * k},{rng.normal()},{rng.normal()}" for r in "abc" for k in range(100)]
    Path("wide.csv").write_text("\n".join(["run,time,u,y", *rows]))
    person = answer(monkeypatch, "d", "c", "", "")
    done = asia("init", "mill", "--train", "wide.csv", "--experiment-column", "run")
    assert done.code == 0, done.err
    assert person.answers == []
    assert "no 'd'; there are a, b, c" in done.out
    problem = load_problem("mill")
    assert [t.name for t in problem.train] == ["a", "b"]
    assert 'test = ["c.csv"]' in (Path("mill") / "problem.toml").read_text()


def test_a_constant_channel_is_no_output(asia: Asia, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    rows = [f"{0.5 * k},{rng.normal()},{rng.normal()},ok,7" for k in range(100)]
    Path("log.csv").write_text("\n".join(["time,flow,level,state,mode", *rows]))
    found = survey(Path("log.csv"), Wanted((), ()))
    assert (found.inputs, found.outputs) == (("flow",), ("level",))
    assert found.unusable == {"state": "holds no numbers", "mode": "is 7 in every sample"}
    person = answer(monkeypatch, "none", "", "mode", "level", "n")
    done = asia("init", "mill", "--train", "log.csv")
    assert done.code == 0, done.err
    assert person.answers == []
    assert "'mode' is 7 in every sample: name another column" in done.out


@pytest.mark.parametrize("given", [(), ("--inputs", "valve", "--outputs", "level")])
def test_a_reference_is_no_input_and_is_kept_for_the_loop(
    asia: Asia, given: tuple[str, ...]
) -> None:
    write("log.csv", "time,valve,SetPoint,level", 4)
    rows = np.loadtxt("log.csv", delimiter=",", skiprows=1)
    done = asia("init", "mill", "--train", "log.csv", "--yes", *given)
    assert done.code == 0, done.err
    assert "SetPoint looks like the reference of a closed loop" in done.out
    path = Path("mill") / "problem.toml"
    assert [s.name for s in load_problem("mill").inputs] == ["valve"]
    text = path.read_text()
    assert '# reference = "SetPoint"' in text
    for line in ("[loop]", "reference =", "enters =", "inputs ="):
        text = text.replace(f"# {line}", line)
    path.write_text(text)
    problem = load_problem("mill")
    assert problem.loop is not None
    assert problem.loop.controller is None
    first = problem.train[0]
    assert first.reference is not None
    np.testing.assert_array_equal(first.reference[:, 0], rows[: len(first), 2])
    np.testing.assert_array_equal(first.u[:, 0], rows[: len(first), 1])


def test_yes_takes_what_is_found_and_says_it(asia: Asia) -> None:
    write("log.csv", "time,flow,temperature", 3)
    done = asia("init", "mill", "--train", "log.csv", "--yes")
    assert done.code == 0, done.err
    assert "inputs   flow" in done.out
    assert "outputs  temperature" in done.out
    assert "sealed" in done.out


def test_a_script_is_asked_nothing(asia: Asia) -> None:
    write("log.csv", "time,flow,temperature", 3)
    for words, says in (
        ((), "--train is missing"),
        (("--yes",), "--train is missing"),
        (("--train", "log.csv"), "--inputs is missing: name the columns"),
        (("--train", "log.csv", "--inputs", "flow"), "--outputs is missing"),
    ):
        done = asia("init", "mill", *words)
        assert done.code == 2
        assert says in done.err
        assert not Path("mill").exists()


def test_names_between_commas(asia: Asia) -> None:
    write("log.csv", "time,a,b,c", 4)
    done = asia("init", "mill", "--train", "log.csv", "--inputs", "a,b", "--outputs", "c")
    assert done.code == 0, done.err
    assert [s.name for s in load_problem("mill").inputs] == ["a", "b"]


@pytest.mark.parametrize(
    ("header", "inputs", "outputs"),
    [
        ("u,y", ("u",), ("y",)),
        ("y1,y2,u", ("u",), ("y1", "y2")),
        ("u1,u2,level", ("u1", "u2"), ("level",)),
        ("pump,valve,level", ("pump", "valve"), ("level",)),
        ("speed,y", ("speed",), ("y",)),
    ],
)
def test_columns_are_told_by_their_names(
    header: str, inputs: tuple[str, ...], outputs: tuple[str, ...]
) -> None:
    write("log.csv", header, header.count(",") + 1)
    found = survey(Path("log.csv"), Wanted((), ()))
    assert (found.inputs, found.outputs, found.timed) == (inputs, outputs, False)


def test_files_are_found_and_answers_split() -> None:
    for name in ("b.csv", "a.csv", "my_test.csv"):
        write(name, "u,y", 2)
    Path("notes.md").write_text("nothing")
    assert record_files(Path()) == ([Path("a.csv"), Path("b.csv")], [Path("my_test.csv")])
    assert split_names("pump speed", ["pump speed"]) == ["pump speed"]
    assert split_names("pump speed, valve") == ["pump speed", "valve"]
    assert split_names("u1 u2") == ["u1", "u2"]
