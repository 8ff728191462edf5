"""Test samples that are copies of training samples."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from asia.data import Trajectory
from asia.data.relations import samples_outside, shared_samples


def brute(test: list[Trajectory], train: list[Trajectory]) -> int:
    def runs(record: Trajectory) -> list[tuple[float, ...]]:
        rows = np.concatenate([record.u, record.y], axis=1)
        return [tuple(rows[k : k + 10].ravel()) for k in range(len(rows) - 9)]

    known = {run for record in train for run in runs(record)}
    count = 0
    for record in test:
        inside: set[int] = set()
        for k, run in enumerate(runs(record)):
            if run in known and len({run[i : i + 2] for i in range(0, 20, 2)}) > 1:
                inside |= set(range(k, k + 10))
        count += len(inside)
    return count


@given(seed=st.integers(0, 2**31), levels=st.integers(1, 3), copied=st.integers(0, 25))
def test_copied_samples_are_counted(seed: int, levels: int, copied: int) -> None:
    random = np.random.default_rng(seed)

    def rows(most: int) -> np.ndarray:
        return random.integers(0, levels, size=(random.integers(5, most), 2)).astype(float)

    train, test = [rows(70) for _ in range(3)], [rows(60) for _ in range(2)]
    part = train[0][2 : 2 + copied]
    test[0] = np.concatenate([test[0], part, test[0][:3]])
    made = [[Trajectory(x[:, :1], x[:, 1:], 1.0, "r") for x in xs] for xs in (test, train)]
    assert shared_samples(*made) == brute(*made)


def test_samples_beyond_the_training_inputs_are_counted() -> None:
    def record(*u: list[float]) -> Trajectory:
        return Trajectory(np.array(u).T, np.zeros((len(u[0]), 1)), 1.0, "r")

    train = [record([0.0, 1.0], [5.0, 5.0]), record([-1.0, 0.0], [5.0, 6.0])]
    test = [record([-1.01, -1.1, 1.0], [5.0, 4.0, 7.0]), record([2.0], [5.5])]
    assert samples_outside(test, train) == (2, 2)
