"""Relations between the simulations of one model, each on one request."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property

import numpy as np

from asia.data import Array
from asia.errors import CandidateError, Reason
from asia.evaluation._batches import CaseBatch
from asia.evaluation._requests import CaseSimulator

TINY, COARSE = 1e-6, 1e-2
STARTS = 4

# Errors and changes below are in standard deviations of the outputs.
_SAME = 1e-3
_STILL = 1e-9
_MOVES = 1e-2
_ISOLATED = 30.0
_EARLY = 5
_WORSE, _MUCH_WORSE = 0.1, 5.0
_PARTED, _GROWS, _PARTS, _LEAST_APART = 0.1, 4.0, 6, 1e-3
_OF_THE_MACHINE = (Reason.SIMULATE_TIMEOUT, Reason.MEMORY)
_SHORTEST = 10
_RECENT = 10


class SuspicionKind(StrEnum):
    """Relation that a model breaks."""

    REPLAY = "replay"
    STRANGERS = "strangers"
    BLOCK_END = "block end"
    CAUSALITY = "causality"
    PERTURBATION = "perturbation"
    TABLE = "table"
    RESTART = "restart"
    CONSISTENCY = "consistency"


@dataclass(frozen=True)
class Suspicion:
    """A relation that a model breaks."""

    kind: SuspicionKind
    """The relation."""
    words: str
    """Description of the violation without a number. Agents receive this text alone: a figure would
    leak held-out data."""
    figure: float
    """Size of the violation in standard deviations of the outputs; for `restart` the error from
    later starts over the error from the scored one."""


@dataclass(frozen=True)
class Continuation:
    """Simulations continued inside a block from simulated outputs up to its end; None where not
    finite."""

    beginning: Array | None
    """Outputs for the first inputs of the longer request."""
    short: Array | None
    """Outputs of the shorter request."""
    long: Array | None
    """Outputs of the longer request."""


@dataclass(frozen=True)
class RequestCheck:
    """The relations on one request."""

    simulator: CaseSimulator
    """Simulator under test."""
    batch: CaseBatch
    """Request with its scored outputs."""
    scale: Array
    """Standard deviations of the outputs, (ny,)."""
    random: np.random.Generator
    """Draws the signs of perturbations."""

    @cached_property
    def nearby(self) -> tuple[Array | None, Array | None]:
        """Simulate with inputs and past changed by 1e-6, in both directions."""
        moved = self.batch.moved(TINY, self.scale, self.random)
        return self.ask(next(moved)), self.ask(next(moved))

    def perturbation(self) -> Suspicion | None:
        """Test continuity: two perturbed simulations must be about as near to the scored one as to
        each other, and none may jump from the first sample on, because chaos needs time to grow."""
        first, second = self.nearby
        if first is None or second is None:
            words = "changing the inputs by 1e-6 makes the simulation diverge"
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
        words = "changing the inputs by 1e-6 makes the simulation jump"
        return Suspicion(SuspicionKind.PERTURBATION, words, least)

    def table(self) -> Suspicion | None:
        """Outputs that move in time but depend on no input and no past output are stored data."""
        near = self.ask(next(self.batch.moved(COARSE, self.scale, self.random)))
        if near is None:
            return None
        y_hat = self.batch.y_hat[: self.batch.count]
        moves = (y_hat.std(axis=1) / self.scale).max(axis=1)
        still = self._apart(near, self.batch.y_hat).max(axis=1) <= _STILL
        taped = moves[still & (moves > _MOVES)]
        if taped.size == 0:
            return None
        words = (
            "changing inputs and past by 1e-2 changes no output, although the output varies in time"
        )
        return Suspicion(SuspicionKind.TABLE, words, float(taped.max()))

    def begins_with(self, answer: Array) -> bool:
        """Return whether this is the start of the scored outputs: then `causality` has no
        objection."""
        whole = self.batch.y_hat[:, : answer.shape[1]]
        return float(self._apart(answer, whole).max(initial=0.0)) <= _SAME

    def causality(self, length: int, answer: Array | None) -> Suspicion | None:
        """Test causality on the first `length` inputs alone, whose outputs must be the start of the
        outputs for all inputs.

        The test is void where a change of the inputs by 1e-6 has an effect of the same size.
        """
        change = np.inf
        if answer is not None:
            change = self._beyond_rounding(answer, self.batch.y_hat[:, :length])
        if change <= _SAME:
            return None
        words = "inputs after a sample change the output before it"
        return Suspicion(SuspicionKind.CAUSALITY, words, change)

    def ask_continuation(self, lengths: tuple[int, int]) -> Continuation:
        """Simulate the last samples of the block, started from the simulated outputs before
        them."""
        short, long = lengths
        later = self.batch.ending(long)
        beginning, last = self.ask(later.prefix(short)), self.ask(self.batch.ending(short))
        return Continuation(beginning, last, self.ask(later))

    def block_end(self, found: Continuation) -> tuple[Suspicion | None, ...]:
        """Test whether a model that continues from its own outputs returns to its own simulation.

        An initial difference, because the past window shows only part of the state, must grow no
        more than a difference of 1e-6 does; a simulation that is drawn to the data after the block
        deviates from it.
        """
        whole, overall = self.batch.y_hat, self.batch.y_hat - self.batch.y
        if _rms(overall[: self.batch.count] / self.scale) >= 1.0:
            return ()
        parts = [
            self._parting(answer, whole[:, -answer.shape[1] :])
            for answer in (found.short, found.long)
            if answer is not None
        ]
        ahead = 0.0
        if found.beginning is not None and found.long is not None:
            length = found.beginning.shape[1]
            ahead = self._beyond_rounding(found.beginning, found.long[:, :length])
        last = max(parts, default=0.0)
        words = "continued from its own outputs, the simulation reaches another end"
        sooner = "the length of a simulation changes its output"
        return (
            Suspicion(SuspicionKind.BLOCK_END, words, last) if last > 0 else None,
            Suspicion(SuspicionKind.CAUSALITY, sooner, ahead) if ahead > _SAME else None,
        )

    def _parting(self, answer: Array, known: Array) -> float:
        """The difference in the last part, 0 where it has not grown by more than it may."""
        apart = self._apart(answer, known)
        length = apart.shape[1]
        last, growth = _last_and_growth(apart)
        near = [a for a in self.nearby if a is not None]
        usual = _last_and_growth(self._apart(near[0], near[1])[:, :length])[1] if near[1:] else 1.0
        return last if last > _PARTED and growth > _GROWS * max(usual, 1.0) else 0.0

    def _beyond_rounding(self, one: Array, other: Array) -> float:
        """Return the largest difference beyond the growth of rounding errors: less than that of
        1e-6, at that sample or the few before it."""
        apart = self._apart(one, other)
        near = [a for a in self.nearby if a is not None]
        if len(near) == 2:
            grown = self._apart(near[0], near[1])[:, : apart.shape[1]]
            grown = np.pad(grown, ((0, 0), (_RECENT, 0)))
            recent = np.lib.stride_tricks.sliding_window_view(grown, _RECENT + 1, axis=1)
            apart = np.where(apart > recent.max(axis=2), apart, 0.0)
        return float(apart.max(initial=0.0))

    def replay(self) -> Suspicion | None:
        """Test that the outputs of a case do not depend on earlier requests."""
        answer = self.ask(self.batch)
        change = np.inf if answer is None else float(self._apart(answer, self.batch.y_hat).max())
        if change <= _SAME:
            return None
        words = "the same case simulated again gives another output"
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
            answer = self.ask(later)
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

    def lengths(self, fractions: tuple[float, float, float]) -> tuple[int, int, int] | None:
        """Lengths of prefixes, None where a case is too short to have any."""
        whole = self.batch.u.shape[1]
        if whole < 2:
            return None
        short, middle, long = (min(max(int(part * whole), 1), whole - 1) for part in fractions)
        return short, middle, long

    def ask(self, batch: CaseBatch) -> Array | None:
        """Simulate a request; None where the outputs are not finite."""
        try:
            answer = self.simulator.simulate(batch.past_u, batch.past_y, batch.u)
        except CandidateError as error:
            if error.reason is Reason.NOT_FINITE:
                return None
            raise
        return answer

    def _apart(self, one: Array, other: Array) -> Array:
        """(rows, H): largest difference over the outputs, of the rows that count."""
        count = self.batch.count
        apart = one[:count] - other[:count]
        np.abs(apart, out=apart)
        apart /= self.scale
        return apart[..., 0] if apart.shape[2] == 1 else apart.max(axis=2)


def restart_suspicion(checks: Sequence[RequestCheck]) -> Suspicion | None:
    """Compare the best of the later starts with the scored one, over all requests."""
    try:
        known = [error for check in checks if (error := check.restart()) is not None]
    except CandidateError as error:
        if error.reason in _OF_THE_MACHINE:
            raise
        words = "the simulation fails from a later start on the same record"
        return Suspicion(SuspicionKind.RESTART, words, np.inf)
    if not known:
        return None
    own = float(np.sqrt(np.mean([error for error, _ in known])))
    later = np.sqrt(np.mean([others for _, others in known], axis=0))
    best = float(later.min())
    if best - own <= _WORSE or best <= _MUCH_WORSE * own:
        return None
    ratio = best / own if own > 0 else np.inf
    words = "the simulation is far worse from a later start on the same record"
    return Suspicion(SuspicionKind.RESTART, words, ratio)


def _last_and_growth(apart: Array) -> tuple[float, float]:
    """The largest value (rows, H) in the last part, and that over the largest in the first."""
    part = max(apart.shape[1] // _PARTS, 1)
    first, last = float(apart[:, :part].max()), float(apart[:, -part:].max())
    return last, last / max(first, _LEAST_APART * last, 1e-300)


def _rms(values: Array) -> float:
    with np.errstate(over="ignore"):
        return float(np.sqrt(np.mean(values**2)))
