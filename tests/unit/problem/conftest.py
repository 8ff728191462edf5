"""Small problems on disk for the tests of this room."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

MINIMAL = """\
sampling_time = 0.1
inputs = ["u"]
outputs = ["y"]
[data]
train = ["train.csv"]
test = ["test.csv"]
"""


def record_text(samples: int, seed: int) -> str:
    """A first-order system with columns t, u, y, sampled every 0.1 s."""
    random = np.random.default_rng(seed)
    u = np.repeat(random.standard_normal(samples // 5 + 1), 5)[:samples].tolist()
    y = [0.0]
    for value in u[:-1]:
        y.append(0.8 * y[-1] + 0.2 * value)
    rows = [f"{k / 10:.1f},{u[k]!r},{y[k]!r}" for k in range(samples)]
    return "\n".join(["t,u,y", *rows, ""])


@pytest.fixture
def record() -> Callable[[int, int], str]:
    """CSV text of a record by its number of samples and seed."""
    return record_text


@pytest.fixture
def write_problem(tmp_path: Path) -> Callable[..., Path]:
    """Writes a problem directory with train.csv and test.csv and returns it."""

    def write(toml: str = MINIMAL, samples: int = 120, train: str | None = None) -> Path:
        directory = tmp_path / "problem"
        directory.mkdir()
        (directory / "train.csv").write_text(train or record_text(samples, 1))
        (directory / "test.csv").write_text(record_text(80, 2))
        (directory / "problem.toml").write_text(toml)
        return directory

    return write


@pytest.fixture
def minimal() -> str:
    """The smallest problem.toml."""
    return MINIMAL
