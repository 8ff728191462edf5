"""The training curve as the worker keeps it."""

from __future__ import annotations


class TrainingCurve:
    """Training curve of bounded size: thinned by two whenever it is full."""

    def __init__(self, rows: int) -> None:
        self._rows = rows
        self._stride = 1
        self._calls = 0
        self._kept: list[tuple[float, float]] = []

    def log(self, step: float, loss: float) -> None:
        """Keep a point, or leave it out."""
        if self._calls % self._stride == 0:
            if len(self._kept) == self._rows:
                self._kept = self._kept[::2]
                self._stride *= 2
            if self._calls % self._stride == 0:
                self._kept.append((float(step), float(loss)))
        self._calls += 1

    def tobytes(self) -> bytes:
        """Steps and losses as float64, row after row."""
        import numpy as np

        return np.array(self._kept, dtype="<f8").tobytes()
