"""Requests to workers: which worker simulates which case, and in which order."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import Protocol, TypeVar

import numpy as np

from asia.candidate import library_only
from asia.data.segment import Segment, stacked
from asia.data.trajectory import Array, filled
from asia.judge.scoring.outcome import check_reply
from asia.problem.protocol import ProtocolRule

MOST_TRAINING_WINDOWS = 256
MOST_SESSIONS = 16

T = TypeVar("T")


class CaseSimulator(Protocol):
    """A fitted model, or a worker that holds one. Raises CandidateError."""

    @property
    def has_steps(self) -> bool:
        """Whether it answers sample by sample; by prefixes otherwise."""
        ...

    def simulate(self, past_u: Array, past_y: Array, u: Array, secret: bytes = b"") -> Array:
        """Simulate cases, shapes as in `asia.candidate.Model.simulate`, so that no answer can
        depend on a later input; outputs are finite."""
        ...

    def simulate_known(self, past_u: Array, past_y: Array, u: Array) -> Array:
        """Simulate cases by the model's own `simulate`; outputs are finite."""
        ...


def sessions(blocks: Sequence[Segment]) -> list[list[int]]:
    """The blocks of each worker, as indices into `blocks`, in the order in which it is asked.

    A worker simulates the blocks of one record, one after the other in time order, so that it has
    seen nothing but their past. A block that begins before the end of the one before it, whose
    inputs would be its future, has a worker of its own. Beyond MOST_SESSIONS workers, each
    simulates several records, one after the other.
    """
    found: list[list[int]] = []
    for record in dict.fromkeys(block.record for block in blocks):
        own = [i for i, block in enumerate(blocks) if block.record == record]
        part: list[int] = []
        for i in sorted(own, key=lambda i: blocks[i].start):
            if part and blocks[i].start < blocks[part[-1]].stop:
                found.append(part)
                part = []
            part.append(i)
        found.append(part)
    if len(found) <= MOST_SESSIONS:
        return found
    return [list(chain.from_iterable(found[k::MOST_SESSIONS])) for k in range(MOST_SESSIONS)]


def secret_of(blocks: Sequence[Segment]) -> bytes:
    """A digest of the held-out outputs, which no worker has."""
    return hashlib.sha256(b"".join(block.y.tobytes() for block in blocks)).digest()


def side_by_side(source: str, rule: ProtocolRule) -> bool:
    """Return whether windows of a candidate may go side by side: no row of a batch depends on
    another in code of the library."""
    return rule.horizon is not None and library_only(source)


def simulate_each(
    worker: CaseSimulator,
    blocks: Sequence[Segment],
    order: Iterable[int],
    secret: bytes | None,
    *,
    together: bool = False,
) -> dict[int, Array]:
    """Simulate blocks one by one.

    Args:
        order: indices into `blocks`
        secret: `secret_of` all blocks; None to show all inputs at once, which no search does
        together: blocks of the same size go side by side, which is faster; see `side_by_side`

    Returns:
        outputs (H, ny) by index

    Raises:
        CandidateError: when the worker fails
    """
    groups: dict[object, list[int]] = {}
    for i in order:
        block = blocks[i]
        size = len(block.past_u), len(block.past_y), len(block.u)
        groups.setdefault(size if together else i, []).append(i)
    found: dict[int, Array] = {}
    for group in groups.values():
        cases = stacked([blocks[i] for i in group])
        if secret is None:
            y_hat = worker.simulate_known(cases.past_u, cases.past_y, cases.u)
        else:
            y_hat = worker.simulate(cases.past_u, cases.past_y, cases.u, secret)
        for i, simulated in zip(group, y_hat, strict=True):
            check_reply(simulated, blocks[i].y.shape)
            found[i] = simulated
    return found


def simulate_held_out(worker: CaseSimulator, blocks: Sequence[Segment]) -> tuple[Array, ...]:
    """Simulate held-out blocks in one worker, record by record in time order; outputs (H, ny) in
    the order of `blocks`. Raises CandidateError."""
    found = simulate_each(worker, blocks, chain(*sessions(blocks)), secret_of(blocks))
    return tuple(found[i] for i in range(len(blocks)))


def simulate_training(
    simulate: Callable[[Array, Array, Array], Array], blocks: Sequence[Segment], horizon: int | None
) -> tuple[Array, ...]:
    """Simulate blocks whose outputs the candidate was given, many windows a request.

    Args:
        simulate: `CaseSimulator.simulate_known`
    """
    count = len(blocks) if horizon is None else -(-len(blocks) // MOST_TRAINING_WINDOWS)
    found: list[Array] = []
    for part in np.array_split(np.arange(len(blocks)), max(count, 1)):
        cases = [blocks[i] for i in part.tolist()]
        # Requests of one size, so that a model compiles once.
        cases += cases[:1] * (-(-len(blocks) // max(count, 1)) - len(cases))
        together = stacked(cases)
        y_hat = simulate(together.past_u, together.past_y, together.u)
        for index, simulated in zip(part.tolist(), y_hat, strict=False):
            check_reply(simulated, blocks[index].y.shape)
            found.append(simulated)
    return tuple(found)


def spread(each: Sequence[T], most: int) -> tuple[T, ...]:
    """Choose at most `most`, evenly spread."""
    places = np.linspace(0, len(each) - 1, min(len(each), most)).round().astype(int)
    return tuple(each[place] for place in places.tolist())


# Scored cases, and the changed cases that test whether a model is one.

MOST_BLOCKS, MOST_WINDOWS = 6, 24
_MOTION = 3


@dataclass(frozen=True)
class ScoredCase:
    """Scored case with its simulated outputs, a batch of one."""

    past_u: Array
    """(1, n_past_u, nu)."""
    past_y: Array
    """(1, n_past_y, ny)."""
    u: Array
    """(1, H, nu)."""
    y: Array
    """Measured outputs, (1, H, ny)."""
    y_hat: Array
    """Simulated outputs, (1, H, ny)."""
    followed: bool = False
    """Whether data that come right after the block train."""

    def moved(self, size: float, scale: Array, random: np.random.Generator) -> Iterator[ScoredCase]:
        """Inputs and past window moved up or down at random by `size` standard deviations; and
        moved the opposite way. One after the other: long ones are large."""
        spread = self.u.std(axis=(0, 1))
        spread = np.where(spread > 0, spread, np.abs(self.u).max(axis=(0, 1)))
        given = (self.past_u, spread), (self.past_y, scale), (self.u, spread)
        steps = [random.choice((-1.0, 1.0), a.shape) for a, _ in given]
        for step, (_, unit) in zip(steps, given, strict=True):
            step *= size * unit
        for way in (np.add, np.subtract):
            past_u, past_y, u = (way(a, d) for (a, _), d in zip(given, steps, strict=True))
            yield replace(self, past_u=past_u, past_y=past_y, u=u)

    def beginning(self, length: int) -> ScoredCase:
        """The first `length` samples."""
        u, y, y_hat = (values[:, :length] for values in (self.u, self.y, self.y_hat))
        return replace(self, u=u, y=y, y_hat=y_hat)

    def ending(self, length: int) -> ScoredCase:
        """The last `length` samples of the same case, started from simulated outputs."""
        start = self.u.shape[1] - length
        return replace(
            self,
            past_u=_past(self.past_u, self.u, start),
            past_y=_past(self.past_y, self.y_hat, start),
            u=self.u[:, start:],
        )

    def later_starts(self, number: int, scale: Array) -> Iterator[tuple[ScoredCase, int]]:
        """Yield the same segment from `number` later starts in the first half, with the sample of
        the start. A past window that does not hold the whole state gives a better start at rest
        than in motion. Each part of the first half therefore gives the sample at which the outputs
        move most nearly as fast as at the scored start. After the last input it is held."""
        length, half = self.u.shape[1], self.u.shape[1] // 2
        # (half + 1,): mean absolute step of the outputs over the few samples from each one on.
        y = np.concatenate([self.past_y[0, -1:], self.y[0]])
        steps = (np.abs(np.diff(y, axis=0)) / scale).mean(axis=1)
        near = steps[: half + 1].copy()
        for ahead in range(1, _MOTION):
            later = steps[ahead : half + 1 + ahead]
            near[: len(later)] += later
        motion = near / np.minimum(len(steps) - np.arange(half + 1), _MOTION) + 1e-3
        for part in np.array_split(np.arange(1, half + 1), number):
            start = int(part[np.abs(np.log(motion[part] / motion[0])).argmin()])
            held = np.repeat(self.u[:, -1:], start, axis=1)
            yield (
                replace(
                    self,
                    past_u=_past(self.past_u, self.u, start),
                    past_y=_past(self.past_y, self.y, start),
                    u=np.concatenate([self.u[:, start:length], held], axis=1),
                ),
                start,
            )


def _past(before: Array, values: Array, start: int) -> Array:
    """The samples just before `start`, as many as `before` has of those before sample 0."""
    count = before.shape[1]
    if start >= count:
        return values[:, start - count : start].copy()
    return np.concatenate([before, values[:, :start]], axis=1)[:, start:]


def scored_cases(
    blocks: Sequence[Segment],
    y_hat: Sequence[Array],
    most: int,
    random: np.random.Generator,
    followed: Collection[int] = (),
) -> tuple[ScoredCase, ...]:
    """Draw at most `most` of the scored cases at random.

    Args:
        y_hat: simulated outputs (H, ny)
        followed: blocks right after which data train
    """
    places = np.sort(random.choice(len(blocks), min(len(blocks), most), replace=False)).tolist()
    return tuple(
        ScoredCase(
            past_u=blocks[i].past_u[None],
            past_y=blocks[i].past_y[None],
            u=blocks[i].u[None],
            y=filled(blocks[i].y)[None],
            y_hat=y_hat[i][None],
            followed=i in followed,
        )
        for i in places
    )
