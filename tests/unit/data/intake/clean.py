"""One clean log, which the tests write in many ugly ways."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from asia.data import Trajectory, data_digest
from asia.data.intake.conversion import take_in
from asia.data.intake.sheet import Wanted

STEP = 0.25
COUNT = 60
WANTED = Wanted(("u",), ("y",))


def signals(count: int = COUNT) -> tuple[list[float], list[float], list[float]]:
    """Stamps, inputs and outputs with three decimals."""
    k = np.arange(count)
    u = np.round(np.sin(0.7 * k) * 3, 3)
    y = np.round(1.5 + np.cos(0.3 * k), 3)
    return (k * STEP).tolist(), u.tolist(), y.tolist()


def record(count: int = COUNT) -> Trajectory:
    _, u, y = signals(count)
    return Trajectory(np.array(u), np.array(y), STEP)


def digest(path: Path | Sequence[Path], wanted: Wanted = WANTED, **given: float) -> str:
    """Return the digest of the training records in a file."""
    paths = [path] if isinstance(path, Path) else path
    return data_digest(take_in(paths, wanted, "train", **given).records)  # pyright: ignore


CLEAN = data_digest([record()])
