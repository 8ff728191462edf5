"""Simulated cases of an experiment, as pictures and pages receive them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from asia.data.trajectory import Array, Signal
from asia.ledger.artifacts import Store
from asia.ledger.events import Unsealed
from asia.ledger.run import Run
from asia.ledger.view import Experiment
from asia.problem.protocol import Block, Fold

# Simulated cases of one experiment, as input of the pictures.


@dataclass(frozen=True)
class SimulatedCase:
    """One case with its measured output and the simulation of a fold's model."""

    fold: int
    """Number of the fold, from 1."""
    held_out: bool
    """True if the fold holds the case out; otherwise its model was fitted to it."""
    record: str
    """Name of the record."""
    start: int
    """First sample in that record, from 0."""
    u: tuple[tuple[float, ...], ...]
    """Inputs, a row a sample."""
    y: tuple[tuple[float, ...], ...]
    """Measured outputs, a row a sample."""
    y_hat: tuple[tuple[float, ...], ...]
    """Simulated outputs, a row a sample."""

    def arrays(self) -> tuple[Array, Array, Array]:
        """u (H, nu), y (H, ny) and y_hat (H, ny)."""
        return np.array(self.u), np.array(self.y), np.array(self.y_hat)


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
    cases: tuple[SimulatedCase, ...]
    """Cases by fold, training cases before held-out ones."""


def simulated_cases(
    fold: Fold, blocks: Sequence[Block], y_hat: Sequence[Array], *, held_out: bool
) -> tuple[SimulatedCase, ...]:
    """Blocks of a fold, training or held-out ones, with their simulations (H, ny)."""
    offsets = () if held_out else fold.offsets
    return tuple(
        SimulatedCase(
            fold.index + 1,
            held_out,
            b.case.name,
            b.start + (offsets[b.record] if offsets else 0),
            _rows(b.case.u),
            _rows(b.y),
            _rows(simulated),
        )
        for b, simulated in zip(blocks, y_hat, strict=True)
    )


def _rows(values: Array) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(row) for row in values.tolist())


# Simulated outputs as a run recorded them.


def fold_outputs(
    store: Store, experiment: Experiment, folds: Sequence[Fold]
) -> tuple[tuple[Array, ...], ...]:
    """Simulated held-out blocks (H, ny) of each fold, as the search recorded them."""
    assert experiment.result is not None
    return tuple(
        store.get_arrays(record.y_hat, [b.y.shape for b in fold.validation])
        for record, fold in zip(experiment.result.folds, folds, strict=True)
    )


def opened_windows(run: Run, opened: Unsealed, artifact: str) -> tuple[Array, ...]:
    """Test outputs of a protocol with windows, measured or simulated: one (horizon, ny) array a
    window."""
    assert opened.horizon is not None
    shapes = [(length, len(opened.channels)) for length in opened.lengths]
    rows = np.concatenate(run.store.get_arrays(artifact, shapes))
    return tuple(rows.reshape(-1, opened.horizon, len(opened.channels)))
