"""Metamorphic checks: relations between the answers of any model of a dynamical system."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property
from itertools import cycle
from typing import TypeAlias

import numpy as np

from asia.data.trajectory import Array
from asia.errors import CandidateError, Reason
from asia.judge.evaluation.requests import (
    CaseBatch,
    CaseSimulator,
    among_strangers,
    batches,
    held_out_requests,
    largest,
    simulate_alone,
    simulate_requests,
)
from asia.judge.evaluation.results import SUSPICIOUS_RATIO, FoldResult, consistency
from asia.judge.scoring.outcome import Failure
from asia.problem.folds import Block

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
    LITERALS = "literals"
    """The gain of a new best does not come from data in its source."""


@dataclass(frozen=True)
class Suspicion:
    """A relation that a model breaks."""

    kind: SuspicionKind
    words: str
    """Description of the violation without a number. Agents receive this text alone: a figure would
    leak held-out data."""
    figure: float
    """Size of the violation in standard deviations of the outputs; for `restart` the error from
    later starts over the error from the scored one."""


Continuation: TypeAlias = tuple[Array | None, Array | None, Array | None]
"""Simulations continued inside a block from simulated outputs up to its end: outputs for the first
inputs of the longer request, of the shorter request, and of the longer one; None where not
finite."""


@dataclass(frozen=True)
class RequestCheck:
    """The relations on one request."""

    simulator: CaseSimulator
    batch: CaseBatch
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

    def ask_continuation(self, short: int, long: int) -> Continuation:
        """Simulate the last samples of the block, started from the simulated outputs before
        them."""
        later = self.batch.ending(long)
        beginning, last = self.ask(later.prefix(short)), self.ask(self.batch.ending(short))
        return beginning, last, self.ask(later)

    def block_end(self, found: Continuation) -> tuple[Suspicion | None, ...]:
        """Test whether a model that continues from its own outputs returns to its own simulation.

        An initial difference, because the past window shows only part of the state, must grow no
        more than a difference of 1e-6 does; a simulation that is drawn to the data after the block
        deviates from it.
        """
        beginning, short, long = found
        whole, overall = self.batch.y_hat, self.batch.y_hat - self.batch.y
        if _rms(overall[: self.batch.count] / self.scale) >= 1.0:
            return ()
        first, second = self.nearby
        end = 0.0
        for answer in (short, long):
            if answer is None:
                continue
            length = answer.shape[1]
            last, growth = _last_and_growth(self._apart(answer, whole[:, -length:]))
            usual = 1.0
            if first is not None and second is not None:
                usual = _last_and_growth(self._apart(first, second)[:, :length])[1]
            if last > _PARTED and growth > _GROWS * max(usual, 1.0):
                end = max(end, last)
        ahead = 0.0
        if beginning is not None and long is not None:
            ahead = self._beyond_rounding(beginning, long[:, : beginning.shape[1]])
        words = "continued from its own outputs, the simulation reaches another end"
        sooner = "the length of a simulation changes its output"
        return (
            Suspicion(SuspicionKind.BLOCK_END, words, end) if end > 0 else None,
            Suspicion(SuspicionKind.CAUSALITY, sooner, ahead) if ahead > _SAME else None,
        )

    def _beyond_rounding(self, one: Array, other: Array) -> float:
        """Return the largest difference beyond the growth of rounding errors: less than that of
        1e-6, at that sample or the few before it."""
        apart = self._apart(one, other)
        first, second = self.nearby
        if first is not None and second is not None:
            grown = self._apart(first, second)[:, : apart.shape[1]]
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

    def length(self, fraction: float) -> int:
        """Length of a prefix, shorter than the cases."""
        whole = self.batch.u.shape[1]
        return min(max(int(fraction * whole), 1), whole - 1)

    def ask(self, batch: CaseBatch) -> Array | None:
        """Simulate a request; None where the outputs are not finite."""
        try:
            return self.simulator.simulate(batch.past_u, batch.past_y, batch.u)
        except CandidateError as error:
            if error.reason is Reason.NOT_FINITE:
                return None
            raise

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


# Metamorphic checks: relations that hold between simulations of any model of a dynamical system.
#
# A lookup table reproduces its own cases and fails on cases close to them. Relations between
# simulations need no threshold on how good a model may be (Chen et al., ACM Computing Surveys
# 51(1), 2018).

ROUNDING = 1e-6
# V of sequential fits over V, above which the folds exchanged data.
_UNLIKE = 1.5
_BY_ITSELF = 24
# Parts of a case that are asked alone: a short one, and two anywhere beyond.
_SHORT, _FURTHER = (0.02, 0.25), (0.25, 1.0)
# Further lengths, for a model that answers in less time than a compilation takes.
_MORE, _MORE_SECONDS, _COMPILES = 24, 1.0, 0.1


def suspicions(
    simulator: CaseSimulator,
    blocks: Sequence[Block],
    y_hat: Sequence[Array],
    scale: Array,
    horizon: int | None,
    seed: int = 0,
    *,
    followed: Collection[int] = (),
    without: Collection[SuspicionKind] = (),
    rounding: float = ROUNDING,
) -> tuple[Suspicion, ...]:
    """Return the relations that a model breaks on held-out blocks; () for an honest one.

    First, on whole blocks that data follow, the simulation is continued from its own outputs to the
    block's end (`block end`: another end, though it began alike). Then the relations of
    `dependences` are tested.

    Then, on at most six requests, inputs and past are moved by 1e-6 of their standard deviations,
    there and back (`perturbation`: an isolated response, or an immediate jump), and by 1e-2
    (`table`: no change at all). The scored requests are repeated (`replay`). Last, because their
    past windows are held-out outputs, four later starts on the same record are simulated where the
    output moves about as fast (`restart`: all much worse over the rest of it, or failing).

    Args:
        simulator: the model, best in a fresh worker, which has simulated nothing
        blocks: held-out blocks
        y_hat: the scored outputs (H, ny) of `blocks`
        scale: (ny,) standard deviations of the outputs
        horizon: that of the protocol
        seed: for the choice of requests, of prefixes and of the signs of perturbations, unknown
            to the author of the model
        followed: the blocks right after which data train
        without: relations that are left out
        rounding: standard deviations by which other cases in a request may change an output

    Raises:
        CandidateError: where a simulation fails; for `restart` only where time or memory ran
            out. An output that is not finite breaks `perturbation`, `restart`, `replay`,
            `strangers` and `causality`, and is ignored by the others.
    """
    inquiry = _Inquiry(simulator, blocks, y_hat, scale, horizon, seed, rounding, followed)
    # Continuations come before all other requests: a longer one would reveal where they start.
    continued = [
        (check, check.ask_continuation(*map(check.length, inquiry.fractions[1:])))
        for check in (inquiry.longer if SuspicionKind.BLOCK_END not in without else ())
        if check.batch.followed
    ]
    found = inquiry.dependences(ahead=SuspicionKind.CAUSALITY not in without)
    for check in inquiry.checks:
        found += check.perturbation(), check.table()
    found += [check.replay() for check in reversed(inquiry.checks)]
    for check, answers in continued:
        found += check.block_end(answers)
    found.append(restart_suspicion(inquiry.checks))
    return _worst(found, without)


def dependences(
    simulator: CaseSimulator,
    blocks: Sequence[Block],
    y_hat: Sequence[Array],
    scale: Array,
    horizon: int | None,
    seed: int = 0,
    *,
    without: Collection[SuspicionKind] = (),
    rounding: float = ROUNDING,
) -> tuple[Suspicion, ...]:
    """Return the broken relations that need no measured output; arguments as for `suspicions`.

    The first inputs of at most six requests are simulated alone, at three random lengths, and at
    more where that is quick (`causality`: the output is not the start of the scored one). Then a
    few cases are simulated without any other, and all of them in another order and among other
    cases (`strangers`: an output changes by more than rounding). So a simulation cannot depend on
    the cases before it in the scored order, after it, or in the same request.
    """
    inquiry = _Inquiry(simulator, blocks, y_hat, scale, horizon, seed, rounding)
    found = inquiry.dependences(ahead=SuspicionKind.CAUSALITY not in without)
    return _worst(found, without)


def strangers(
    simulator: CaseSimulator,
    blocks: Sequence[Block],
    y_hat: Sequence[Array],
    scale: Array,
    horizon: int | None,
    seed: int,
    rounding: float = ROUNDING,
    most: int | None = None,
) -> Suspicion | None:
    """The relation `strangers` alone: first a few cases without any other, then all of them, or
    about `most`, among others."""
    random = np.random.default_rng(seed)
    requests = held_out_requests(blocks, horizon)
    rows = largest(requests)
    place = {index: row for request in requests for row, index in enumerate(request)}
    count = min(len(blocks), _BY_ITSELF if most is None else most)
    by_itself = random.choice(len(blocks), count, replace=False).tolist()
    mixed = among_strangers(requests, random)[: None if most is None else -(-most // rows)]
    answers: list[tuple[int, Array]] = []
    try:
        for index in by_itself if rows > 1 else ():
            answers.append((index, simulate_alone(simulator, blocks[index], place[index], rows)))
        answers += simulate_requests(simulator, blocks, mixed, rows).items()
    except CandidateError as error:
        if error.reason is not Reason.NOT_FINITE:
            raise
        change = np.inf
    else:
        apart = [np.abs(y - y_hat[index]) / scale for index, y in answers]
        change = max((float(a.max(initial=0.0)) for a in apart), default=0.0)
    words = "a case asked in another order, alone or among other cases, is answered otherwise"
    return Suspicion(SuspicionKind.STRANGERS, words, change) if change > rounding else None


def objection_to(found: Sequence[Suspicion], fold: int | None) -> Failure | None:
    """The failure that the relations found broken come to. RESTART depends on held-out outputs:
    it is the reason only where no other relation is broken."""
    known = [one for one in found if one.kind is not SuspicionKind.RESTART]
    reason = Reason.SUSPECT if known else Reason.RESTART
    words = "; ".join(f"{one.kind}: {one.words}" for one in known or found)
    return Failure(reason, words, fold) if found else None


def _worst(
    found: Sequence[Suspicion | None], without: Collection[SuspicionKind]
) -> tuple[Suspicion, ...]:
    worst: dict[SuspicionKind, Suspicion] = {}
    for one in found:
        if one is None or one.kind in without:
            continue
        if one.kind not in worst or one.figure > worst[one.kind].figure:
            worst[one.kind] = one
    return tuple(worst.values())


class _Inquiry:
    """Requests of one check, in an order in which no output can be copied from an earlier
    request."""

    def __init__(
        self,
        simulator: CaseSimulator,
        blocks: Sequence[Block],
        y_hat: Sequence[Array],
        scale: Array,
        horizon: int | None,
        seed: int,
        rounding: float,
        followed: Collection[int] = (),
    ) -> None:
        random = np.random.default_rng(seed)
        chosen = batches(blocks, y_hat, horizon, random, followed)
        further = np.sort(random.uniform(*_FURTHER, size=2))
        self.fractions = (float(random.uniform(*_SHORT)), float(further[0]), float(further[1]))
        self._more_fractions = random.uniform(_SHORT[0], 1.0, size=_MORE).tolist()
        self.checks = [RequestCheck(simulator, batch, scale, random) for batch in chosen]
        self.longer = [check for check in self.checks if check.batch.u.shape[1] >= 2]
        strangers_seed = int(random.integers(2**31))
        self._strangers = lambda: strangers(
            simulator, blocks, y_hat, scale, horizon, strangers_seed, rounding
        )

    def dependences(self, *, ahead: bool) -> list[Suspicion | None]:
        """Prefixes, where `ahead` asks for them, come before any whole case, and are compared when
        1e-6 was tried too."""
        asked: list[tuple[RequestCheck, int, Array | None]] = []
        checks = self.longer if ahead else []
        slowest = 0.0

        def ask(check: RequestCheck, fraction: float) -> None:
            nonlocal slowest
            begin, length = time.monotonic(), check.length(fraction)
            answer = check.ask(check.batch.prefix(length))
            slowest = max(slowest, time.monotonic() - begin)
            # Equal outputs are dropped: long ones are large.
            if answer is None or not check.begins_with(answer):
                asked.append((check, length, answer))

        # The same three lengths for all, for which a model compiles.
        for place in range(max(len(checks), len(self.fractions)) if checks else 0):
            ask(checks[place % len(checks)], self.fractions[place % len(self.fractions)])
        # Then as many others as a model without compilation simulates in a second.
        end = time.monotonic() + _MORE_SECONDS
        for check, fraction in zip(cycle(checks), self._more_fractions, strict=False):
            if slowest > _COMPILES or time.monotonic() > end:
                break
            ask(check, fraction)
        return [self._strangers(), *(check.causality(k, answer) for check, k, answer in asked)]


def sequential_objection(
    folds: Sequence[FoldResult],
    fit_sequentially: Callable[[int], FoldResult | Failure],
    random: np.random.Generator,
) -> Failure | None:
    """Refit the folds sequentially, in another order, where V is far below the training error, so
    that none can tell another one anything; None where V stays.

    Args:
        fit_sequentially: of the fold at that place
    """
    value = float(np.mean([fold.score.value for fold in folds]))
    errors = [fold.diagnostics.train_error for fold in folds]
    if consistency(value, errors) >= SUSPICIOUS_RATIO:
        return None
    again: list[float] = []
    for place in random.permutation(len(folds)).tolist():
        result = fit_sequentially(place)
        if isinstance(result, Failure):
            words = f"{SuspicionKind.CONSISTENCY}: fitted alone, a fold fails"
            return Failure(Reason.SUSPECT, words, place + 1)
        again.append(result.score.value)
    if np.mean(again) <= _UNLIKE * value:
        return None
    words = "V is far below the training error, but not with the folds fitted one by one"
    return Failure(Reason.SUSPECT, f"{SuspicionKind.CONSISTENCY}: {words}")
