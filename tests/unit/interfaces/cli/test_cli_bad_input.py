"""Whatever a person can mend: one sentence, exit code 2, nothing written."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.unit.ledger.conftest import finished_run

from .conftest import Asia

PHYSICS = """
[physics]
states = ["x"]
[physics.parameters]
a = { min = 0.1, max = 1.0 }
[physics.observation]
y = "x"
[physics.dynamics]
x = "%s"
"""
Spoil = Callable[[Path], object]


def in_toml(before: str, after: str) -> Spoil:
    def spoil(problem: Path) -> None:
        text = (problem / "problem.toml").read_text()
        assert before in text
        (problem / "problem.toml").write_text(text.replace(before, after, 1))

    return spoil


def physics(dynamics: str) -> Spoil:
    def spoil(problem: Path) -> None:
        with (problem / "problem.toml").open("a") as stream:
            stream.write(PHYSICS % dynamics)

    return spoil


def in_rows(change: Callable[[list[str]], list[str]], name: str = "train.csv") -> Spoil:
    """Changes the rows below the header."""

    def spoil(problem: Path) -> None:
        header, *rows = (problem / name).read_text().splitlines()
        (problem / name).write_text("\n".join([header, *change(rows)]) + "\n")

    return spoil


def a_word(rows: list[str]) -> list[str]:
    return [*rows[:9], "wet," + rows[9].split(",")[1], *rows[10:]]


def scaled(factor: float, name: str = "train.csv") -> Spoil:
    def scale(rows: list[str]) -> list[str]:
        pairs = [row.split(",") for row in rows]
        return [f"{u},{float(y) * factor!r}" for u, y in pairs]

    return in_rows(scale, name)


def replaced_by_pipe(name: str) -> Spoil:
    def spoil(problem: Path) -> None:
        (problem / name).unlink()
        os.mkfifo(problem / name)

    return spoil


def without_header(problem: Path) -> None:
    rows = (problem / "train.csv").read_text().splitlines()[1:]
    (problem / "train.csv").write_text("\n".join(rows) + "\n")


def replaced_by_directory(problem: Path) -> None:
    (problem / "train.csv").unlink()
    (problem / "train.csv").mkdir()


def problem_file_is_a_folder(problem: Path) -> None:
    (problem / "problem.toml").unlink()
    (problem / "problem.toml").mkdir()


SPOILT: dict[str, tuple[Spoil, tuple[str, ...]]] = {
    "unknown key": (in_toml("past_inputs", "past_inptus"), ("past_inptus", "past_inputs")),
    "no TOML": (in_toml('name = "toy"', 'name = "toy'), ("problem.toml",)),
    "missing column": (in_toml('["u"]', '["volt"]'), ("train.csv", "'volt'", "u, y")),
    "a word in an input": (in_rows(a_word), ("train.csv", "line 11", "'u'")),
    "a word in the test": (in_rows(a_word, "test.csv"), ("test.csv", "line 11", "'u'")),
    "too few samples": (in_rows(lambda rows: rows[:20]), ("20 samples", "at least 29")),
    "too short a test": (in_rows(lambda rows: rows[:3], "test.csv"), ("test", "3 samples")),
    "test left out": (
        in_toml("past_outputs = 3\n", "past_outputs = 3\ntest = { skip = 117 }\n"),
        ("test record 'test' has 120 samples", "leave out 120"),
    ),
    "constant output": (
        in_rows(lambda rows: [row.split(",")[0] + ",0.1" for row in rows]),
        ("output 'y' is 0.1 in every training sample",),
    ),
    "no header": (without_header, ("train.csv", "the first row holds numbers")),
    "no such file": (lambda p: (p / "train.csv").unlink(), ("no such file", "train.csv")),
    "no such test": (lambda p: (p / "test.csv").unlink(), ("no such file", "test.csv")),
    "not a file": (replaced_by_directory, ("train.csv is a folder",)),
    "a pipe for records": (replaced_by_pipe("train.csv"), ("train.csv: it is a named pipe",)),
    "a pipe for the baseline": (replaced_by_pipe("baseline.py"), ("baseline.py: it is a named",)),
    "huge outputs": (
        scaled(1e200),
        ("output 'y' of training record 'train' is", "at sample 1,", "at most 1e+100", "divide"),
    ),
    "huge outputs in the test": (scaled(1e120, "test.csv"), ("test record 'test'", "1e+100")),
    "tiny outputs": (scaled(1e-310), ("output 'y' moves by", "at least 1e-100", "multiply")),
    "not text": (lambda p: (p / "train.csv").write_bytes(b"\0\1\2"), ("train.csv", "text")),
    "an empty file": (lambda p: (p / "train.csv").write_bytes(b""), ("train.csv", "empty")),
    "only a header": (in_rows(lambda rows: []), ("train.csv",)),
    "a binary problem file": (
        lambda p: (p / "problem.toml").write_bytes(bytes(range(256))),
        ("problem.toml",),
    ),
    "a folder for the problem file": (problem_file_is_a_folder, ("problem.toml",)),
    "a number for a name": (in_toml('name = "toy"', "name = 3"), ("problem.toml", "name")),
    "a text for a list": (in_toml('["u"]', '"u"'), ("problem.toml", "inputs")),
    "a text for a count": (
        in_toml("past_inputs = 3", 'past_inputs = "three"'),
        ("problem.toml", "past_inputs"),
    ),
    "undefined symbol": (physics("-b*x + u"), ("'b'", "[physics.dynamics] x")),
    "call that is not in the table": (physics("-a*system(x)"), ("system", "[physics.dynamics] x")),
    "no baseline": (lambda p: (p / "baseline.py").write_text("def"), ("baseline.py",)),
}


def files(root: Path) -> dict[Path, bytes]:
    return {p: p.read_bytes() if p.is_file() else b"" for p in root.rglob("*")}


@pytest.mark.parametrize("command", ["check", "run"])
@pytest.mark.parametrize("case", SPOILT)
def test_bad_problem(problem: Path, tmp_path: Path, asia: Asia, case: str, command: str) -> None:
    spoil, expected = SPOILT[case]
    spoil(problem)
    before = files(tmp_path)
    done = asia(command, "toy")
    assert done.code == 2
    assert done.out == ""
    assert done.err.startswith("asia: ")
    assert done.err.count("\n") == 1
    for words in expected:
        assert words in done.err
    assert files(tmp_path) == before


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("run", "toy", "--agent", "clever"), "no agent 'clever'; there is: expert, random"),
        (("run", "toy", "--isolation", "moat"), "namespace, landlock, sandbox-exec, process"),
        (("run", "toy", "--name", "../toy"), "--name '../toy': expected letters"),
        (("run", "toy", "--name", "7"), "--name '7': expected letters"),
        (("run", "two_tank_sim"), "did you mean 'two_tanks_sim'?"),
        (("check", "."), "has no problem.toml"),
        (("status",), "no runs under runs; start one with: asia run PROBLEM"),
        (("status", "nowhere"), "no run 'nowhere' under runs; there is: none"),
        (("show", "nowhere", "1"), "no run 'nowhere'"),
        (("show", "1", "2"), "no runs under runs"),
        (("unseal", "nowhere", "--yes"), "no run 'nowhere'"),
        (("report", "nowhere"), "no run 'nowhere'"),
        (("verify", "nowhere"), "no run 'nowhere'"),
    ],
)
def test_bad_words(
    problem: Path, tmp_path: Path, asia: Asia, words: tuple[str, ...], expected: str
) -> None:
    before = files(tmp_path)
    done = asia(*words)
    assert done.code == 2
    assert done.out == ""
    assert done.err.startswith("asia: ")
    assert expected in done.err
    assert done.err.count("\n") == 1
    assert files(tmp_path) == before


@pytest.mark.parametrize(
    "words",
    [
        ("run", "toy", "--experiments", "0"),
        ("run", "toy", "--experiments", "many"),
        ("run", "toy", "--nonsense"),
        ("run", "toy", "--seed", "-1"),
        ("check",),
        ("nonsense",),
    ],
)
def test_bad_usage(problem: Path, tmp_path: Path, asia: Asia, words: tuple[str, ...]) -> None:
    before = files(tmp_path)
    done = asia(*words)
    assert done.code == 2
    assert done.out == ""
    assert "Usage" in done.err
    assert files(tmp_path) == before


def line_changed(run: Path) -> None:
    """A record in the middle, another character."""
    lines = (run / "ledger.jsonl").read_bytes().splitlines(keepends=True)
    middle = len(lines) // 2
    lines[middle] = lines[middle].replace(b'"event"', b'"evemt"', 1)
    (run / "ledger.jsonl").write_bytes(b"".join(lines))


@pytest.mark.parametrize(
    ("words", "spoil", "expected"),
    [
        (("show", "run", "9"), None, "9"),
        (("show", "run", "0"), None, "0"),
        (("show", "run", "1", "9"), None, "9"),
        (("status", "run"), line_changed, "ledger.jsonl"),
        (("show", "run"), line_changed, "ledger.jsonl"),
        (("report", "run"), line_changed, "ledger.jsonl"),
        (("show", "run"), lambda run: (run / "ledger.jsonl").unlink(), "run"),
        (("report", "run"), lambda run: (run / "ledger.jsonl").write_bytes(b"\xff\0"), "ledger"),
    ],
)
def test_bad_run(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    asia: Asia,
    words: tuple[str, ...],
    spoil: Spoil | None,
    expected: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    run = finished_run(tmp_path / "runs" / "run")
    if spoil is not None:
        spoil(run)
    before = files(tmp_path)
    done = asia(*words)
    assert done.code == 2
    assert done.err.startswith("asia: ")
    assert expected in done.err
    assert "Traceback" not in done.err
    assert done.err.count("\n") <= 3
    now = files(tmp_path)
    assert {path: now[path] for path in before} == before
