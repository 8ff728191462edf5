"""Inputs that held-out and training samples share, and folds by period."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter

from asia.data import Signal, Trajectory
from asia.problem.check import check_problem
from asia.problem.folds import make_folds
from asia.problem.load import load_problem
from asia.problem.problem import Problem, Seal
from asia.problem.protocol import FoldRule, Group

RNG = np.random.default_rng(11)
TANKS = load_problem("two_tanks_sim")


def problem_of(*inputs: np.ndarray, folds: FoldRule | None = None) -> Problem:
    columns = [u.reshape(len(u), -1) for u in inputs]
    records = tuple(
        Trajectory(u, np.asarray(lfilter([0, 0.2], [1, -0.8], u[:, :1], axis=0)), 4.0, f"r{k}")
        for k, u in enumerate(columns, 1)
    )
    names = tuple(Signal(f"u{i}") for i in range(columns[0].shape[1]))
    rule = replace(TANKS.protocol, folds=folds or FoldRule(count=3))
    return replace(TANKS, train=records, inputs=names, physics=None, symmetry={}, protocol=rule)


def warnings_of(problem: Problem) -> list[str]:
    found = check_problem(problem, Seal(None)).warnings
    return [text for text in found if "V is too good" in text]


def multisine(period: int, lines: int, periods: float) -> np.ndarray:
    phases = np.random.default_rng(3).uniform(0, 2 * np.pi, lines)
    t = np.arange(round(period * periods))
    return np.sum([np.cos(2 * np.pi * (k + 1) * t / period + p) for k, p in enumerate(phases)], 0)


def coloured(samples: int, pole: float, seed: int = 7) -> np.ndarray:
    return np.asarray(lfilter([1], [1, -pole], np.random.default_rng(seed).normal(size=samples)))


def mirrored() -> np.ndarray:
    half = coloured(512, 0.7)
    u = np.concatenate([half, -half])[:682]
    return u + 0.01 * RNG.normal(size=682)


@pytest.mark.parametrize(
    ("u", "words", "period"),
    [
        (mirrored(), "with the opposite sign", 512),
        (multisine(300, 40, 4.0), "every 300 samples", 300),
        (multisine(400, 3, 3.0), "every 400 samples", 400),
        (np.concatenate([coloured(600, 0.8), 2.5 * coloured(600, 0.8)]), "scaled by", 600),
        (np.tile(np.repeat([1.0, -1.0], 60), 6), "every 120 samples", 120),
    ],
    ids=["mirrored", "multisine", "three lines", "scaled", "square wave"],
)
def test_a_repetition_is_found_and_the_proposed_folds_end_it(
    u: np.ndarray, words: str, period: int
) -> None:
    problem = problem_of(u)
    (text,) = warnings_of(problem)
    assert words in text
    line = re.search(r'folds = \{ kind = "contiguous", count = (\d), period = (\d+) \}', text)
    assert line is not None
    assert int(line[2]) == period
    folds = FoldRule(count=int(line[1]), period=int(line[2]))
    mended = problem_of(u, folds=folds)
    assert not warnings_of(mended)
    for fold in make_folds(mended.train, mended.protocol):
        phases = {t % period for block in fold.held_out for t in range(block.start, block.stop)}
        trained = {
            (start + t) % period
            for start, record in zip(fold.offsets, fold.train, strict=True)
            for t in range(len(record))
        }
        assert not phases & trained


def test_equal_inputs_in_two_groups_are_to_be_one_group() -> None:
    u = coloured(400, 0.8)
    groups = tuple(Group(f"g{k}", (f"r{k}",)) for k in (1, 2, 3))
    folds = FoldRule("leave_one_group_out", 3, groups)
    (text,) = warnings_of(problem_of(u, coloured(500, 0.8, 1), -u, folds=folds))
    assert "opposite sign" in text
    assert "put 'r1' and 'r3' into one group" in text or "put 'r3' and 'r1' into" in text


def prbs(seed: int, samples: int = 1500, hold: int = 5) -> np.ndarray:
    levels = np.random.default_rng(seed).choice([-1.0, 1.0], samples // hold + 1)
    return np.repeat(levels, hold)[:samples]


@pytest.mark.parametrize(("pole", "seed"), [(0.0, 0), (0.9, 1), (0.99, 2), (1.0, 3)])
def test_random_inputs_raise_no_alarm(pole: float, seed: int) -> None:
    assert not warnings_of(problem_of(coloured(3000, pole, seed)))


@pytest.mark.parametrize("noise", [0.0, 0.02])
def test_random_binary_inputs_raise_no_alarm(noise: float) -> None:
    for seed in range(5):
        u = prbs(seed, 1500, hold=4)
        assert not warnings_of(problem_of(u + noise * RNG.normal(size=1500)))


def test_other_inputs_that_look_alike_raise_no_alarm() -> None:
    t = np.arange(3000)
    ramp = t / 3000
    staircase = np.floor(t / 150) + 0.0
    random_steps = np.repeat(np.random.default_rng(2).uniform(-1, 1, 100), 30)
    chirp = np.sin(2 * np.pi * (0.001 * t + 2e-5 * t**2))
    for u in (ramp, ramp + 0.01 * RNG.normal(size=3000), staircase, random_steps, chirp):
        assert not warnings_of(problem_of(u))
    assert not warnings_of(problem_of(prbs(1), prbs(2), prbs(3)))
    # The second input does not repeat.
    both = np.stack([multisine(300, 40, 4.0), RNG.normal(size=1200)], axis=1)
    assert not warnings_of(problem_of(both))


@pytest.mark.parametrize("name", ["two_tanks_sim", "bouc_wen"])
def test_built_in_records_raise_no_alarm_without_reason(name: str) -> None:
    problem = load_problem(name)
    assert not warnings_of(problem)


def test_a_period_is_read_from_the_file_and_belongs_to_contiguous_folds(tmp_path: Path) -> None:
    from asia.errors import UserError

    u = mirrored()
    lines = ["u,y", *(f"{float(a)!r},{float(b)!r}" for a, b in zip(u, np.cumsum(u), strict=True))]
    (tmp_path / "r.csv").write_text("\n".join(lines), encoding="utf-8")
    head = (
        'name = "p"\nsampling_time = 1.0\ninputs = [{ name = "u" }]\noutputs = [{ name = "y" }]\n'
    )
    head += '[data]\ntrain = ["r.csv"]\n[protocol]\n'
    file = tmp_path / "problem.toml"
    file.write_text(head + 'folds = { kind = "contiguous", count = 2, period = 512 }\n', "utf-8")
    problem = load_problem(str(tmp_path))
    held = [[(b.start, b.stop) for b in f.held_out] for f in make_folds(
        problem.train, problem.protocol
    )]  # fmt: skip
    assert held == [[(10, 256), (512, 682)], [(256, 512)]]
    file.write_text(head + 'folds = { kind = "forward", period = 512 }\n', "utf-8")
    with pytest.raises(UserError, match="period belongs to"):
        load_problem(str(tmp_path))
