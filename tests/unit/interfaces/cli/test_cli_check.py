from pathlib import Path

import pytest

from asia.problem.load import builtin_problems

from .conftest import Asia


@pytest.mark.slow
def test_picture_that_cannot_be_written_is_a_note(
    problem: Path, tmp_path: Path, asia: Asia, monkeypatch: pytest.MonkeyPatch
) -> None:
    # A file where the directory should be fails for root too, whom no permission stops.
    (tmp_path / "runs").write_text("")
    done = asia("check", "toy")
    assert done.code == 0
    assert "problem toy" in done.out
    assert "picture" not in done.out
    assert "note: could not draw into runs: " in done.err
    assert "; give --runs DIR or set ASIA_RUNS\n" in done.err
    monkeypatch.setenv("ASIA_RUNS", str(tmp_path / "elsewhere"))
    done = asia("check", "toy")
    # Lines of progress come on a slow machine alone.
    assert all(line.startswith("check: ") for line in done.err.splitlines())
    assert f"picture  {tmp_path / 'elsewhere'}" in done.out


def test_short_test_record_is_said(problem: Path, asia: Asia) -> None:
    test = problem / "test.csv"
    test.write_text("\n".join([*test.read_text().splitlines()[:6], ""]))
    done = asia("check", "toy", "--no-draw")
    assert done.code == 0, done.err
    assert "test (5 samples, 2 scored)" in done.out
    assert "warning: test record 'test' has 2 samples to score" in done.out


@pytest.mark.parametrize("command", ["run", "agent workspace", "check"])
def test_help_names_the_built_in_problems(command: str, asia: Asia) -> None:
    words = asia(*command.split(), "--help").out
    assert all(name in words for name in builtin_problems())
