"""Lines of `asia check` on periods, noise and distortion."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from asia.data import Array
from asia.errors import UserError
from asia.problem.check import response_lines
from asia.problem.load import load_problem

N = 256
FILE = """name = "lab"
sampling_time = 0.01
inputs = ["u"]
outputs = ["y"]
[data]
train = ["a.csv", "b.csv"]
{more}
"""


def signals(seed: int, periods: int) -> tuple[Array, Array]:
    rng = np.random.default_rng(seed)
    lines, time = np.arange(1, N // 8, 2), np.arange(N)[:, None] / N
    one = np.cos(2 * np.pi * lines * time + rng.uniform(0, 2 * np.pi, lines.size)).sum(axis=1)
    u = np.tile(one / one.std(), periods)
    y = u + 0.1 * u**2
    return u, y + 0.01 * y.std() * rng.normal(size=len(y))


@pytest.fixture
def problem_file(tmp_path: Path):
    def written(more: str = "", periods: int = 6) -> Path:
        for seed, name in enumerate(("a.csv", "b.csv")):
            columns = np.stack(signals(seed, periods), axis=1)
            np.savetxt(tmp_path / name, columns, delimiter=",", header="u,y", comments="")
        (tmp_path / "problem.toml").write_text(FILE.format(more=more))
        return tmp_path

    return written


def test_a_period_is_found_and_levels_are_printed(problem_file) -> None:
    problem = load_problem(str(problem_file()))
    first, second = response_lines(problem)
    assert first == "period (found): 256 samples; 6 periods used of each of 2 records"
    assert second.startswith("output y: noise -40 dB, odd distortion ")
    assert "even distortion -" in second
    assert second.endswith("V cannot go below 0.01")


def test_a_declared_period_is_used_and_goes_into_the_lock(problem_file) -> None:
    problem = load_problem(str(problem_file(f"period = {2 * N}")))
    assert problem.period == 2 * N
    assert response_lines(problem)[0].startswith(f"period (declared): {2 * N} samples; 3 periods")


def test_a_period_that_no_record_holds_twice_is_refused(problem_file) -> None:
    with pytest.raises(UserError, match="period = 1000: record 'a' has 1536 samples"):
        load_problem(str(problem_file("period = 1000")))


def test_without_a_period_coherence_speaks(problem_file) -> None:
    problem = load_problem(str(problem_file()))
    rng = np.random.default_rng(0)
    u = rng.normal(size=1500)
    record = replace(problem.train[0], u=u, y=u + 0.1 * rng.normal(size=1500))
    (line,) = response_lines(replace(problem, train=(record,)))
    assert "no period; noise and distortion together -20 dB (squared coherence 0.99)" in line
