"""Simulated cases of an experiment, for analysis, pictures and pages."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from typing import Annotated, Any

import numpy as np
from pydantic import PlainSerializer, PlainValidator

from asia.data.segment import Segment, SimulatedSegment
from asia.data.trajectory import Array, Signal
from asia.judge.artifacts import ArtifactStore
from asia.judge.scoring.outcome import FoldRecord, Score
from asia.ledger.events import Unsealed
from asia.ledger.run import Run
from asia.problem.folds import Fold


def _rows(segment: SimulatedSegment) -> dict[str, Any]:
    """Fields of a segment, arrays as rows of numbers."""
    values = {one.name: getattr(segment, one.name) for one in fields(segment)}
    return {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in values.items()}


def _from_rows(values: SimulatedSegment | dict[str, Any]) -> SimulatedSegment:
    if isinstance(values, SimulatedSegment):
        return values
    read: dict[str, Any] = {
        k: np.array(v, np.float64) if isinstance(v, list) else v for k, v in values.items()
    }
    return SimulatedSegment(**read)


_Sent = Annotated[SimulatedSegment, PlainValidator(_from_rows), PlainSerializer(_rows)]


@dataclass(frozen=True)
class SimulatedCases:
    """Some cases of an experiment's fold models."""

    title: str
    """Title of the picture."""
    sampling_time: float
    """Sampling time, s."""
    windows: bool
    """True if a case is a window, not a record."""
    inputs: tuple[Signal, ...]
    """Names and units of the inputs."""
    outputs: tuple[Signal, ...]
    """Names and units of the outputs."""
    cases: tuple[tuple[int, bool, _Sent], ...]
    """Number of the fold, from 1; whether it holds the case out, or else trains on it; the case.
    By fold, training cases before held-out ones."""


def simulated_cases(
    fold: Fold, blocks: Sequence[Segment], y_hat: Sequence[Array], *, held_out: bool
) -> tuple[tuple[int, bool, SimulatedSegment], ...]:
    """Blocks of a fold, training or held-out ones, with their simulations (H, ny), as
    `SimulatedCases` holds them."""
    offsets = () if held_out else fold.offsets
    return tuple(
        (
            fold.index + 1,
            held_out,
            replace(b, start=b.start + (offsets[b.record] if offsets else 0)).simulated(simulated),
        )
        for b, simulated in zip(blocks, y_hat, strict=True)
    )


# Simulated outputs as a run recorded them, and the most informative of them.


def fold_outputs(
    store: ArtifactStore, records: Sequence[FoldRecord], folds: Sequence[Fold]
) -> tuple[tuple[Array, ...], ...]:
    """Simulated held-out blocks (H, ny) of each fold, as they were recorded."""
    return tuple(
        store.get_arrays(record.y_hat, fold.shapes)
        for record, fold in zip(records, folds, strict=True)
    )


def opened_windows(run: Run, opened: Unsealed, artifact: str) -> tuple[Array, ...]:
    """Test outputs of a protocol with windows, measured or simulated: one (horizon, ny) array a
    window."""
    assert opened.horizon is not None
    shapes = [(length, len(opened.channels)) for length in opened.lengths]
    rows = np.concatenate(run.store.get_arrays(artifact, shapes))
    return tuple(rows.reshape(-1, opened.horizon, len(opened.channels)))


def worst_fits(score: Score) -> list[float]:
    """The lowest fit index of each output over the folds; infinite for an output that does not
    move, which has none."""
    fits = [[np.inf if fit is None else fit for fit in f.fit_index] for f in score.folds]
    return [min(column) for column in zip(*fits, strict=True)]


def lowest(values: Sequence[float], count: int) -> list[int]:
    """Indices of the `count` lowest values, in their own order."""
    return sorted(int(i) for i in np.argsort(values, kind="stable")[: max(count, 1)])


def representative_windows(
    measured: Sequence[Array], simulated: Sequence[Array], scale: Array
) -> Iterator[tuple[str, int]]:
    """The windows with the least, the middle and the largest error, by their index. The error is
    the mean of |error| / scale over samples and outputs; measured, simulated: (H, ny) a window,
    scale (ny,)."""

    def mean_error(error: Array) -> float:
        """Over what was measured; 0 where nothing was."""
        sizes = np.abs(error) / scale
        if np.isnan(error).any():
            sizes = sizes[~np.isnan(error)]
        return float(np.mean(sizes)) if sizes.size else 0.0

    pairs = zip(measured, simulated, strict=True)
    order = np.argsort([mean_error(y - y_hat) for y, y_hat in pairs], kind="stable").tolist()
    seen: set[int] = set()
    for word, index in (
        ("best", order[0]),
        ("median", order[len(order) // 2]),
        ("worst", order[-1]),
    ):
        if index not in seen:
            seen.add(index)
            yield word, index
