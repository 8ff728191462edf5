"""Preprocessing of a new problem, derived from its training records."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from asia.data._delay import find_delay
from asia.data._preprocess import Preprocess
from asia.data._trajectory import Array, Signal, Trajectory
from asia.errors import UserError
from asia.problem._toml import toml_value


@dataclass(frozen=True)
class Preparation:
    """Requested preprocessing."""

    delay: str | None = None
    """`auto`, or the samples by which all inputs are delayed."""
    decimate: int = 1
    """Every Nth sample is kept."""
    detrend: bool = False
    """The mean over the training records is taken off every signal."""
    scale: bool = False
    """Every signal is divided by its standard deviation over the training records."""


def prepare(
    wish: Preparation,
    records: Sequence[Trajectory],
    inputs: Sequence[str],
    outputs: Sequence[str],
) -> Preprocess:
    """The numbers, from training records alone. Raises UserError."""
    if wish.decimate < 1:
        raise UserError(f"--decimate is {wish.decimate}: expected a whole number of at least 1")
    if wish == Preparation():
        return Preprocess()
    first = Preprocess(_delays(wish.delay, records, inputs), wish.decimate)
    signals = tuple(map(Signal, inputs)), tuple(map(Signal, outputs))
    records = [first.record(t, *signals) for t in records]
    values = dict(
        zip(
            (*inputs, *outputs),
            [*_columns([t.u for t in records]), *_columns([t.measured_y for t in records])],
            strict=True,
        )
    )
    # Six digits suffice and are readable.
    offset = {n: float(f"{np.nanmean(v):.6g}") for n, v in values.items()} if wish.detrend else {}
    spread = {n: float(f"{np.nanstd(v):.6g}") for n, v in values.items()} if wish.scale else {}
    return replace(first, offset=offset, scale={n: s for n, s in spread.items() if s > 0})


def preprocess_lines(done: Preprocess) -> str:
    """`[preprocess]` of problem.toml; "" where nothing is done."""
    if not done:
        return ""
    lines = ["", "[preprocess]                        # done to every record alike"]
    for name in ("delay", "decimate", "offset", "scale"):
        value = getattr(done, name)
        if value and value != 1:
            lines.append(f"{name} = {toml_value(value)}")
    return "\n".join(lines) + "\n"


def _columns(arrays: Sequence[Array]) -> list[Array]:
    return list(np.concatenate(arrays).T)


def _delays(
    wish: str | None, records: Sequence[Trajectory], inputs: Sequence[str]
) -> dict[str, int]:
    """Return the delays by input in samples; a model without delay responds at the sample after the
    input's."""
    if wish is None:
        return {}
    if wish != "auto":
        if not wish.isdecimal():
            raise UserError(f"--delay is {wish}: expected auto, or a whole number of samples")
        return {name: int(wish) for name in inputs if int(wish)}
    found: dict[str, int] = {}
    for k, name in enumerate(inputs):
        lags = [find_delay(records, k, c).lag for c in range(records[0].y.shape[1])]
        known = [lag for lag in lags if lag is not None]
        if known and min(known) > 1:
            found[name] = min(known) - 1
    return found
