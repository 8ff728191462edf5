"""Metamorphic checks: relations that hold between simulations of any model of a dynamical system.

A lookup table reproduces its own cases and fails on cases close to them. Relations between
simulations need no threshold on how good a model may be (Chen et al., ACM Computing Surveys 51(1),
2018).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterator, Sequence
from functools import partial
from itertools import cycle

import numpy as np

from asia.data import Array
from asia.errors import CandidateError, Reason
from asia.evaluation._batches import batches
from asia.evaluation._relations import (
    Continuation,
    RequestCheck,
    Suspicion,
    SuspicionKind,
    restart_suspicion,
)
from asia.evaluation._requests import (
    CaseSimulator,
    among_strangers,
    held_out_requests,
    largest,
    simulate_alone,
    simulate_requests,
)
from asia.evaluation._results import FAR_BELOW, FoldResult, consistency
from asia.protocol import Block
from asia.scoring import Failure

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
    inquiry = _Inquiry(simulator, blocks, y_hat, scale, horizon, seed, rounding, followed, without)
    continued = inquiry.continuations() if SuspicionKind.BLOCK_END not in without else []
    found = inquiry.dependences()
    checks = inquiry.checks
    for check in checks:
        found += check.perturbation(), check.table()
    found += [check.replay() for check in reversed(checks)]
    for check, answers in continued:
        found += check.block_end(answers)
    found.append(restart_suspicion(checks))
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
    inquiry = _Inquiry(simulator, blocks, y_hat, scale, horizon, seed, rounding, without=without)
    return _worst(inquiry.dependences(), without)


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
        without: Collection[SuspicionKind] = (),
    ) -> None:
        self._ahead_is_asked = SuspicionKind.CAUSALITY not in without
        random = np.random.default_rng(seed)
        chosen = batches(blocks, y_hat, horizon, random, followed)
        further = np.sort(random.uniform(*_FURTHER, size=2))
        self.fractions = (float(random.uniform(*_SHORT)), float(further[0]), float(further[1]))
        self._more_fractions = random.uniform(_SHORT[0], 1.0, size=_MORE).tolist()
        self._slowest = 0.0
        self.checks = [RequestCheck(simulator, batch, scale, random) for batch in chosen]
        self._strangers = partial(
            strangers, simulator, blocks, y_hat, scale, horizon, int(random.integers(2**31)),
            rounding,
        )  # fmt: skip

    def dependences(self) -> list[Suspicion | None]:
        """Prefixes come before any whole case, and are compared when 1e-6 was tried too."""
        lengths = self._prefixes() if self._ahead_is_asked else ()
        asked: list[tuple[RequestCheck, int, Array | None]] = []
        for check, length in lengths:
            answer = self._prefix(check, length)
            # Equal outputs are dropped: long ones are large.
            if answer is None or not check.begins_with(answer):
                asked.append((check, length, answer))
        return [self._strangers(), *(check.causality(k, answer) for check, k, answer in asked)]

    def _prefixes(self) -> Iterator[tuple[RequestCheck, int]]:
        """Yield requests and lengths: the same three lengths for all, for which a model compiles;
        then as many others as a model without compilation simulates in a second."""
        checks = [check for check in self.checks if check.lengths(self.fractions) is not None]
        for place in range(max(len(checks), len(self.fractions)) if checks else 0):
            check = checks[place % len(checks)]
            lengths = check.lengths(self.fractions)
            assert lengths is not None
            yield check, lengths[place % len(lengths)]
        end = time.monotonic() + _MORE_SECONDS
        for check, part in zip(cycle(checks), self._more_fractions, strict=False):
            if self._slowest > _COMPILES or time.monotonic() > end:
                return
            whole = check.batch.u.shape[1]
            yield check, min(max(int(part * whole), 1), whole - 1)

    def _prefix(self, check: RequestCheck, length: int) -> Array | None:
        begin = time.monotonic()
        answer = check.ask(check.batch.prefix(length))
        self._slowest = max(self._slowest, time.monotonic() - begin)
        return answer

    def continuations(self) -> list[tuple[RequestCheck, Continuation]]:
        """Simulate continuations before all other requests: a longer request would reveal where
        they start."""
        return [
            (check, check.ask_continuation(lengths[1:]))
            for check in self.checks
            for lengths in [check.lengths(self.fractions)]
            if check.batch.followed and lengths is not None
        ]


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
    if consistency(value, errors) >= FAR_BELOW:
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
