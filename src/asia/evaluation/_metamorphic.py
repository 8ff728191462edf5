"""Metamorphic checks: relations that hold between the answers of any model of a dynamical system.

A lookup table answers the cases it was made for and fails on cases close to them. Relations between
answers need no threshold on how good a model may be (Chen et al., ACM Computing Surveys 51(1),
2018).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Protocol

import numpy as np

from asia.data import Array
from asia.errors import CandidateError, Reason
from asia.evaluation._batches import CaseBatch, batches
from asia.protocol import Block

TINY, COARSE = 1e-6, 1e-2
STARTS = 4

# Errors and changes below are in standard deviations of the outputs.
_SAME = 1e-3
_STILL = 1e-9
_MOVES = 1e-2
_ISOLATED = 30.0
_EARLY = 5
_WORSE, _MUCH_WORSE = 0.1, 5.0
_OF_THE_MACHINE = (Reason.SIMULATE_TIMEOUT, Reason.MEMORY)
_SHORTEST = 10


class SuspicionKind(StrEnum):
    """Which relation a model breaks."""

    REPLAY = "replay"
    ORDER = "order"
    CAUSALITY = "causality"
    PERTURBATION = "perturbation"
    TABLE = "table"
    RESTART = "restart"


@dataclass(frozen=True)
class Suspicion:
    """A relation that a model breaks."""

    kind: SuspicionKind
    """The relation."""
    words: str
    """How it is broken, without a number. Agents receive the words alone: a figure would carry
    held-out data out."""
    figure: float
    """By how much, in standard deviations of the outputs; for `restart` the error from later starts
    over the error from the scored one."""


class CaseSimulator(Protocol):
    """A fitted model, or a worker that holds one. Raises CandidateError."""

    def simulate(self, past_u: Array, past_y: Array, u: Array) -> Array:
        """As `asia.candidate.Model.simulate`; finite."""
        ...


def suspicions(
    simulator: CaseSimulator,
    blocks: Sequence[Block],
    y_hat: Sequence[Array],
    scale: Array,
    horizon: int | None,
    seed: int = 0,
) -> tuple[Suspicion, ...]:
    """The relations that a model breaks on held-out blocks; () for an honest one.

    y_hat: its answers (H, ny) to `blocks`, which `simulator` must have given in the order of
    `asia.evaluation.simulate_held_out` before; scale (ny,): standard deviations of the outputs;
    horizon: that of the protocol; seed: for the choice of requests and the signs of perturbations,
    unknown to whoever wrote the model.

    On at most six requests, in the shapes of the scored ones so that nothing compiles anew, it asks
    for: inputs and past moved by 1e-6 of their standard deviations, there and back
    (`perturbation`: an isolated answer, or a jump at once), and by 1e-2 (`table`: no change at
    all); the second half of the inputs exchanged (`causality`); rows in another order (`order`);
    the same again (`replay`); and, last, as their past windows are held-out outputs, four later
    starts on the same record, where the output moves about as fast (`restart`: all much worse over
    the rest of it, or failing). Raises CandidateError where an answer does not come, but for
    `restart` only where time or memory ran out; one that is not finite breaks `perturbation`,
    `restart` and `replay`, and says nothing about the others.
    """
    found: list[Suspicion | None] = []
    random = np.random.default_rng(seed)
    chosen = batches(blocks, y_hat, horizon, random)
    checks = [_RequestCheck(simulator, batch, scale, random) for batch in chosen]
    for check in checks:
        found += check.perturbation(), check.table(), check.causality(), check.order()
    found += [check.replay() for check in reversed(checks)]
    found.append(_restart(checks))
    worst: dict[SuspicionKind, Suspicion] = {}
    for one in found:
        if one is not None and (one.kind not in worst or one.figure > worst[one.kind].figure):
            worst[one.kind] = one
    return tuple(worst.values())


@dataclass(frozen=True)
class _RequestCheck:
    """The relations on one request."""

    simulator: CaseSimulator
    """What answers."""
    batch: CaseBatch
    """The request and its scored answer."""
    scale: Array
    """Standard deviations of the outputs, (ny,)."""
    random: np.random.Generator
    """Draws the signs of perturbations."""

    def perturbation(self) -> Suspicion | None:
        """Answers to two cases close to the scored one must lie about as near to its answer as to
        each other, and none may jump from the first sample on: chaos needs time to grow."""
        there, back = self.batch.moved(TINY, self.scale, self.random)
        first, second = self._ask(there), self._ask(back)
        if first is None or second is None:
            words = "inputs moved by 1e-6 make the simulation diverge"
            both = first is None and second is None
            return Suspicion(SuspicionKind.PERTURBATION, words, np.inf) if both else None
        jumps = [self._apart(y, self.batch.y_hat) for y in (first, second)]
        least = min(_rms(jump) for jump in jumps)
        between = _rms(self._apart(first, second))
        at_once = all(
            (part > _MOVES).mean() > 0.5 for jump in jumps for part in (jump[:, :_EARLY], jump)
        )
        isolated = least > _SAME and least > _ISOLATED * between
        if not isolated and not at_once:
            return None
        words = "inputs moved by 1e-6 make the simulation jump"
        return Suspicion(SuspicionKind.PERTURBATION, words, least)

    def table(self) -> Suspicion | None:
        """Outputs that move in time but depend on no input and no past output are stored data."""
        near = self._ask(self.batch.moved(COARSE, self.scale, self.random)[0])
        if near is None:
            return None
        y_hat = self.batch.y_hat[: self.batch.count]
        moves = (y_hat.std(axis=1) / self.scale).max(axis=1)
        still = self._apart(near, self.batch.y_hat).max(axis=1) <= _STILL
        taped = moves[still & (moves > _MOVES)]
        if taped.size == 0:
            return None
        words = "inputs and past moved by 1e-2 change no output, though the output moves in time"
        return Suspicion(SuspicionKind.TABLE, words, float(taped.max()))

    def causality(self) -> Suspicion | None:
        """Up to the splice, the answer to the spliced case is that to the scored one."""
        spliced, place = self.batch.spliced()
        answer = self._ask(spliced)
        if answer is None:
            return None
        change = float(self._apart(answer, self.batch.y_hat)[:, :place].max(initial=0.0))
        if change <= _SAME:
            return None
        words = "inputs after a sample move the output before it"
        return Suspicion(SuspicionKind.CAUSALITY, words, change)

    def order(self) -> Suspicion | None:
        """The answer to a case does not depend on the other cases of its request. Rounding may
        differ from row to row, and grow: a change counts only if it is there from the start on."""
        if self.batch.count < 2:
            return None
        answer = self._ask(self.batch.reversed())
        if answer is None:
            return None
        change = self._apart(answer[::-1], self.batch.y_hat)
        middle = float(np.median(change))
        if middle <= _MOVES or float(np.median(change[:, :_EARLY])) <= _SAME:
            return None
        words = "cases in another order move the simulation"
        return Suspicion(SuspicionKind.ORDER, words, middle)

    def replay(self) -> Suspicion | None:
        """The answer to a case does not depend on the requests before it."""
        answer = self._ask(self.batch)
        change = np.inf if answer is None else float(self._apart(answer, self.batch.y_hat).max())
        if change <= _SAME:
            return None
        words = "the same case asked again is answered otherwise"
        return Suspicion(SuspicionKind.REPLAY, words, change)

    def restart(self) -> tuple[float, list[float]] | None:
        """Mean squared error over the end of the blocks, from the scored start and from later
        ones; None where there is no later start to compare with."""
        batch = self.batch
        if batch.past_y.shape[1] == 0 or batch.u.shape[1] < _SHORTEST:
            return None
        end = batch.u.shape[1] * 3 // 5
        wanted = np.s_[: batch.count, end:]
        with np.errstate(over="ignore"):
            own = float(np.mean(((batch.y_hat - batch.y)[wanted] / self.scale) ** 2))
        others: list[float] = []
        for later, starts in batch.later_starts(STARTS, self.scale):
            answer = self._ask(later)
            if answer is None:
                others.append(np.inf)
                continue
            rows = [
                (answer[i, end - s : len(answer[i]) - s] - batch.y[i, end:]) / self.scale
                for i, s in enumerate(starts[: batch.count])
            ]
            with np.errstate(over="ignore"):
                others.append(float(np.mean(np.square(rows))))
        return own, others

    def _ask(self, batch: CaseBatch) -> Array | None:
        """The answer; None where it is not finite."""
        try:
            answer = self.simulator.simulate(batch.past_u, batch.past_y, batch.u)
        except CandidateError as error:
            if error.reason is Reason.NOT_FINITE:
                return None
            raise
        return answer

    def _apart(self, one: Array, other: Array) -> Array:
        """(rows, H): largest difference over the outputs, of the rows that count."""
        return (np.abs(one - other)[: self.batch.count] / self.scale).max(axis=2)


def _restart(checks: Sequence[_RequestCheck]) -> Suspicion | None:
    """Over all requests: the best of the later starts against the scored one."""
    try:
        known = [error for check in checks if (error := check.restart()) is not None]
    except CandidateError as error:
        if error.reason in _OF_THE_MACHINE:
            raise
        words = "started later on the same record the simulation fails"
        return Suspicion(SuspicionKind.RESTART, words, np.inf)
    if not known:
        return None
    own = float(np.sqrt(np.mean([error for error, _ in known])))
    later = np.sqrt(np.mean([others for _, others in known], axis=0))
    best = float(later.min())
    if best - own <= _WORSE or best <= _MUCH_WORSE * own:
        return None
    ratio = best / own if own > 0 else np.inf
    words = "started later on the same record the simulation is far worse"
    return Suspicion(SuspicionKind.RESTART, words, ratio)


def _rms(values: Array) -> float:
    with np.errstate(over="ignore"):
        return float(np.sqrt(np.mean(values**2)))
