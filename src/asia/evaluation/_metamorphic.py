"""Metamorphic checks: relations that hold between the answers of any model of a dynamical system.

A lookup table answers the cases it was made for and fails on cases close to them. Relations between
answers need no threshold on how good a model may be (Chen et al., ACM Computing Surveys 51(1),
2018).
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from functools import partial

import numpy as np

from asia.data import Array
from asia.errors import CandidateError, Reason
from asia.evaluation._batches import batches
from asia.evaluation._relations import (
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
    simulate_requests,
)
from asia.protocol import Block

ROUNDING = 1e-6
_PREFIXES = (0.25, 0.65), (0.65, 1.0)


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
    """The relations that a model breaks on held-out blocks; () for an honest one.

    simulator: the model, best in a fresh worker, which has answered nothing; y_hat: the scored
    answers (H, ny) to `blocks`; scale (ny,): standard deviations of the outputs; horizon: that of
    the protocol; seed: for the choice of requests, of prefixes and of the signs of perturbations,
    unknown to whoever wrote the model; followed: the blocks right after which data train; without:
    relations that are left out; rounding: by how many standard deviations other cases may move an
    answer.

    First comes what `dependences` asks. Then, on at most six requests, inputs and past moved by
    1e-6 of their standard deviations, there and back (`perturbation`: an isolated answer, or a jump
    at once), and by 1e-2 (`table`: no change at all); the scored requests again (`replay`); on
    whole blocks that data follow two later starts (`block end`: both much worse at the end); and,
    last, as their past windows are held-out outputs, four later starts on the same record, where
    the output moves about as fast (`restart`: all much worse over the rest of it, or failing).
    Raises CandidateError where an answer does not come, but for `restart` only where time or memory
    ran out; one that is not finite breaks `perturbation`, `restart`, `replay`, `strangers` and
    `causality`, and says nothing about the others.
    """
    inquiry = _Inquiry(simulator, blocks, y_hat, scale, horizon, seed, rounding, followed)
    found = inquiry.dependences()
    checks = inquiry.checks
    for check in checks:
        found += check.perturbation(), check.table()
    found += [check.replay() for check in reversed(checks)]
    for check in checks:
        lengths = check.lengths(inquiry.fractions)
        if check.batch.followed and lengths is not None and SuspicionKind.BLOCK_END not in without:
            found += check.block_end(lengths)
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
    """The relations that need no measured output; arguments as for `suspicions`.

    The simulator is asked for the first inputs of at most six requests alone, at two random
    lengths (`causality`: the answer is not the start of the scored one), then for all cases in
    another order and among other cases (`strangers`: an answer changes by more than rounding). So
    it cannot know what came before a case in the scored order, after it, or beside it.
    """
    inquiry = _Inquiry(simulator, blocks, y_hat, scale, horizon, seed, rounding)
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
    """The relation `strangers` alone; most: about how many cases are asked, None for all."""
    random = np.random.default_rng(seed)
    requests = held_out_requests(blocks, horizon)
    rows = largest(requests)
    mixed = among_strangers(requests, random)[: None if most is None else -(-most // rows)]
    try:
        answers = simulate_requests(simulator, blocks, mixed, rows)
    except CandidateError as error:
        if error.reason is not Reason.NOT_FINITE:
            raise
        change = np.inf
    else:
        apart = [np.abs(y - y_hat[i]) / scale for i, y in answers.items()]
        change = max((float(a.max(initial=0.0)) for a in apart), default=0.0)
    words = "a case asked in another order, among other cases, is answered otherwise"
    return Suspicion(SuspicionKind.STRANGERS, words, change) if change > rounding else None


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
    """What one call asks, in an order in which no answer can be taken from an earlier request."""

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
        self.fractions = [float(random.uniform(low, high)) for low, high in _PREFIXES]
        self.checks = [RequestCheck(simulator, batch, scale, random) for batch in chosen]
        self._strangers = partial(
            strangers, simulator, blocks, y_hat, scale, horizon, int(random.integers(2**31)),
            rounding,
        )  # fmt: skip

    def dependences(self) -> list[Suspicion | None]:
        """Prefixes come before any whole case, and are compared when 1e-6 was tried too."""
        asked = [
            (check, length, check.ask_prefix(length))
            for place in range(max(len(self.checks), len(_PREFIXES)) if self.checks else 0)
            for check in [self.checks[place % len(self.checks)]]
            for lengths in [check.lengths(self.fractions)]
            if lengths is not None
            for length in [lengths[place % len(lengths)]]
        ]
        return [self._strangers(), *(check.causality(k, answer) for check, k, answer in asked)]
