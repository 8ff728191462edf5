"""Metamorphic checks: relations between the answers of any model of a dynamical system."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property
from itertools import pairwise

import numpy as np

from asia.data.segment import Segment
from asia.data.trajectory import Array, filled
from asia.errors import CandidateError, Reason
from asia.judge.evaluation.requests import (
    MOST_BLOCKS,
    MOST_WINDOWS,
    CaseSimulator,
    ScoredCase,
    scored_cases,
    secret_of,
    simulate_each,
)
from asia.judge.sandbox.worker.prefixes import SHORT, chunk_ends
from asia.judge.scoring.outcome import Failure

TINY, COARSE = 1e-6, 1e-2
STARTS = 4

# Errors and changes below are in standard deviations of the outputs.
_SAME = 1e-3
_STILL = 1e-9
_MOVES = 1e-2
_UNCHANGED = 40
_ISOLATED = 30.0
_EARLY = 5
_WORSE, _MUCH_WORSE = 0.1, 5.0
_PARTED, _GROWS, _PARTS, _LEAST_APART = 0.1, 4.0, 6, 1e-3
_OF_THE_MACHINE = (Reason.SIMULATE_TIMEOUT, Reason.MEMORY)
_SHORTEST = 10
# Samples of a long case that are checked.
_LONGEST = 10_000


class SuspicionKind(StrEnum):
    """Relation that a model breaks."""

    REPLAY = "replay"
    STRANGERS = "strangers"
    BLOCK_END = "block end"
    LOOK_AHEAD = "look-ahead"
    PERTURBATION = "perturbation"
    TABLE = "table"
    RESTART = "restart"


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


@dataclass(frozen=True)
class CaseCheck:
    """The relations on one scored case."""

    simulator: CaseSimulator
    block: ScoredCase
    """The whole case."""
    scale: Array
    """Standard deviations of the outputs, (ny,)."""
    random: np.random.Generator
    """Draws the signs of perturbations."""
    secret: bytes | None
    """As for `requests.simulate_each`."""

    @cached_property
    def case(self) -> ScoredCase:
        """The case; its beginning for a model with `step`, whose answers to the first inputs do not
        depend on later ones."""
        return self.block.beginning(_LONGEST) if self.simulator.has_steps else self.block

    @cached_property
    def nearby(self) -> tuple[Array | None, Array | None]:
        """Simulate with inputs and past changed by 1e-6, in both directions."""
        moved = self.case.moved(TINY, self.scale, self.random)
        return self.ask(next(moved), scored=True), self.ask(next(moved), scored=True)

    def perturbation(self) -> Suspicion | None:
        """Test continuity: two perturbed simulations must be about as near to the scored one as to
        each other, and none may jump from the first sample on, because chaos needs time to grow."""
        first, second = self.nearby
        if first is None or second is None:
            words = "changing the inputs by 1e-6 makes the simulation diverge"
            both = first is None and second is None
            return Suspicion(SuspicionKind.PERTURBATION, words, np.inf) if both else None
        jumps = [self._apart(y, self.case.y_hat) for y in (first, second)]
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
        y_hat, length = self.case.y_hat, self.case.u.shape[1]
        moves = float((y_hat.std(axis=1) / self.scale).max())
        if moves <= _MOVES:
            return None
        unchanged = 0
        for moved in self.case.moved(COARSE, self.scale, self.random):
            near = self.ask(moved, scored=True)
            if near is not None and self.apart(near) <= _STILL:
                unchanged += length
        # A short output may be rounded to the same numbers by chance.
        if unchanged < min(_UNCHANGED, 2 * length):
            return None
        words = (
            "changing inputs and past by 1e-2 changes no output, although the output varies in time"
        )
        return Suspicion(SuspicionKind.TABLE, words, moves)

    def continued(self, fractions: Sequence[float]) -> list[Array]:
        """Simulate the last samples of the block, started from the simulated outputs before
        them; those that are finite."""
        longest = self.case.u.shape[1]
        lengths = [min(max(int(f * self.block.u.shape[1]), 1), longest - 1) for f in fractions]
        found = [self.ask(self.block.ending(length)) for length in lengths]
        return [y for y in found if y is not None]

    def block_end(self, continued: Sequence[Array]) -> Suspicion | None:
        """Test whether a model that continues from its own outputs returns to its own simulation.

        An initial difference, because the past window shows only part of the state, must grow no
        more than a difference of 1e-6 does; a simulation that is drawn to the data after the block
        deviates from it.
        """
        whole = self.block.y_hat
        if _rms((whole - self.block.y) / self.scale) >= 1.0:
            return None
        first, second = self.nearby
        end = 0.0
        for answer in continued:
            length = answer.shape[1]
            last, growth = _last_and_growth(self._apart(answer, whole[:, -length:]))
            usual = 1.0
            if first is not None and second is not None:
                usual = _last_and_growth(self._apart(first, second)[:, :length])[1]
            if last > _PARTED and growth > _GROWS * max(usual, 1.0):
                end = max(end, last)
        words = "continued from its own outputs, the simulation reaches another end"
        return Suspicion(SuspicionKind.BLOCK_END, words, end) if end > 0 else None

    def replay(self) -> Suspicion | None:
        """Test that the outputs of a case do not depend on earlier requests."""
        answer = self.ask(self.case, scored=True)
        change = np.inf if answer is None else self.apart(answer)
        if change <= _SAME:
            return None
        words = "the same case simulated again gives another output"
        return Suspicion(SuspicionKind.REPLAY, words, change)

    def restart(self) -> tuple[float, list[float]] | None:
        """Mean squared error over the end of the block, from the scored start and from later
        ones; None where there is no later start to compare with."""
        case, length = self.case, self.case.u.shape[1]
        if case.past_y.shape[1] == 0 or length < _SHORTEST:
            return None
        end = length * 3 // 5

        def error(y_hat: Array) -> float:
            with np.errstate(over="ignore"):
                return float(np.mean(((y_hat - case.y[:, end:]) / self.scale) ** 2))

        others: list[float] = []
        for later, start in case.later_starts(STARTS, self.scale):
            answer = self.ask(later)
            part = slice(end - start, length - start)
            others.append(np.inf if answer is None else error(answer[:, part]))
        return error(case.y_hat[:, end:]), others

    def ask(self, case: ScoredCase, *, scored: bool = False) -> Array | None:
        """Simulate a case; None where the outputs are not finite. Only one that is compared with
        scored answers sample by sample is asked by prefixes."""
        cases = case.past_u, case.past_y, case.u
        try:
            if self.secret is not None and (scored or self.simulator.has_steps):
                return self.simulator.simulate(*cases, self.secret)
            return self.simulator.simulate_known(*cases)
        except CandidateError as error:
            if error.reason is Reason.NOT_FINITE:
                return None
            raise

    def apart(self, answer: Array) -> float:
        """Largest difference from the scored outputs."""
        return float(self._apart(answer, self.case.y_hat).max(initial=0.0))

    def _apart(self, one: Array, other: Array) -> Array:
        """(1, H): largest difference over the outputs."""
        apart = one - other
        np.abs(apart, out=apart)
        apart /= self.scale
        return apart[..., 0] if apart.shape[2] == 1 else apart.max(axis=2)


def restart_suspicion(checks: Sequence[CaseCheck]) -> Suspicion | None:
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
# Cases that are asked again in a fresh worker.
MOST_STRANGERS = 24
# Parts of a block from which a simulation is continued.
_FURTHER = (0.25, 1.0)
# Excess of the error without look-ahead, in its standard errors.
_SIGNIFICANT = 2.5
# Excess of the number of ends with a larger error, in its standard deviations.
_MORE_OFTEN = 3.5


def suspicions(
    simulator: CaseSimulator,
    blocks: Sequence[Segment],
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
    block's end (`block end`: another end, though it began alike). Then `strangers` and, for a model
    without `step`, `look_ahead` are tested.

    Then, on at most 6 blocks or 24 windows (a third of them for a model without `step`), inputs and
    past are moved by 1e-6 of their standard deviations, there and back (`perturbation`: an isolated
    response, or an immediate jump), and by 1e-2 (`table`: no change at all). The scored cases are
    repeated (`replay`). Last, because their past windows are held-out outputs, four later starts on
    the same record are simulated where the output moves about as fast (`restart`: all much worse
    over the rest of it, or failing).

    Args:
        simulator: the model, best in a fresh worker, which has simulated nothing
        blocks: held-out blocks
        y_hat: the scored outputs (H, ny) of `blocks`
        scale: (ny,) standard deviations of the outputs
        horizon: that of the protocol
        seed: for the choice of cases, of continuations and of the signs of perturbations, unknown
            to the author of the model
        followed: the blocks right after which data train
        without: relations that are left out
        rounding: standard deviations by which other cases before may change an output

    Raises:
        CandidateError: where a simulation fails; for `restart` only where time or memory ran
            out. An output that is not finite breaks `perturbation`, `restart`, `replay`,
            `strangers` and `look-ahead`, and is ignored by the others.
    """
    random = np.random.default_rng(seed)
    secret = None if SuspicionKind.LOOK_AHEAD in without else secret_of(blocks)
    most = (MOST_BLOCKS if horizon is None else MOST_WINDOWS) // (1 if simulator.has_steps else 3)
    cases = scored_cases(blocks, y_hat, most, random, followed)
    fractions: list[float] = np.sort(random.uniform(*_FURTHER, size=2)).tolist()
    checks = [CaseCheck(simulator, case, scale, random, secret) for case in cases]
    # Continuations come before all other requests: a longer one would reveal where they start.
    continued = [
        (check, check.continued(fractions))
        for check in (checks if SuspicionKind.BLOCK_END not in without else ())
        if horizon is None and check.block.followed and check.case.u.shape[1] >= 2
    ]
    found: list[Suspicion | None] = []
    if secret is not None and not simulator.has_steps:
        found.append(look_ahead(checks, blocks, y_hat, secret))
    other_seed = int(random.integers(2**31))
    if SuspicionKind.STRANGERS not in without:
        found += strangers(simulator, blocks, y_hat, secret, scale, other_seed, rounding)
    for check in checks:
        found += check.perturbation(), check.table()
    found += [check.replay() for check in reversed(checks)]
    found += [check.block_end(answers) for check, answers in continued]
    found.append(restart_suspicion(checks))
    return _worst(found, without)


def strangers(
    simulator: CaseSimulator,
    blocks: Sequence[Segment],
    y_hat: Sequence[Array],
    secret: bytes | None,
    scale: Array,
    seed: int,
    rounding: float = ROUNDING,
    most: int = MOST_STRANGERS,
) -> tuple[Suspicion, ...]:
    """Ask at most `most` cases again, in random order: an answer depends on no case before it."""
    random = np.random.default_rng(seed)
    order = random.choice(len(blocks), min(len(blocks), most), replace=False).tolist()
    try:
        answers = simulate_each(simulator, blocks, order, secret)
    except CandidateError as error:
        if error.reason is not Reason.NOT_FINITE:
            raise
        change = np.inf
    else:
        apart = [np.abs(y - y_hat[index]) / scale for index, y in answers.items()]
        change = max((float(a.max(initial=0.0)) for a in apart), default=0.0)
    words = "a case asked after other cases is answered otherwise"
    return (Suspicion(SuspicionKind.STRANGERS, words, change),) if change > rounding else ()


def look_ahead(
    checks: Sequence[CaseCheck], blocks: Sequence[Segment], y_hat: Sequence[Array], secret: bytes
) -> Suspicion | None:
    """Test whether a model answered by prefixes gains by the inputs that a chunk has sent ahead.

    A causal model simulates a whole case as it simulates its prefixes. Where it does not, as an
    adaptive solver may, samples answered without any later input must have no larger errors than
    those around them.
    """
    whole = [check.ask(check.case) for check in checks]
    pairs = zip(checks, whole, strict=True)
    if all(y is not None and check.apart(y) <= _SAME for check, y in pairs):
        return None
    scale = checks[0].scale
    excess: list[float] = []
    free: list[float] = []
    for block, simulated in zip(blocks, y_hat, strict=True):
        if len(block.u) <= SHORT:
            continue
        errors = np.nanmean(((simulated - filled(block.y)) / scale) ** 2, axis=1)
        ends = chunk_ends(block.past_u[None], block.past_y[None], block.u[None], secret)
        chunks = [errors[a:b] for a, b in pairwise([0, *ends])]
        for chunk, later in pairwise(chunks):
            if len(chunk) > 1 and len(later) > 1:
                free.append(float(chunk[-1]))
                excess.append(float(chunk[-1] - (chunk[:-1].mean() + later[:-1].mean()) / 2))
    if len(excess) < 2:
        return None
    count = len(excess)
    error = float(np.std(excess, ddof=1)) / np.sqrt(count)
    # Few large errors hide the mean, but not how many ends are worse: half of them by chance.
    worse = sum(one > 0 for one in excess)
    often = 2 * worse - count > _MORE_OFTEN * np.sqrt(count)
    if np.mean(excess) <= _SIGNIFICANT * error and not often:
        return None
    words = "samples simulated without a later input have larger errors than those around them"
    share = float(np.sum(excess) / np.sum(free))
    return Suspicion(SuspicionKind.LOOK_AHEAD, words, share)


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
