"""Open the sealed test, once, and say how the search's winner does on it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import get_args

import numpy as np

from asia._diagnostic import diagnostic
from asia.data.trajectory import Array, Mask, Trajectory, data_digest
from asia.errors import CandidateError, UserError
from asia.judge.evaluation.evaluator import Evaluator
from asia.judge.evaluation.results import mean_simulation
from asia.judge.sandbox.levels import LEVELS
from asia.judge.scoring.outcome import Failure, mee_table, score_test
from asia.ledger.artifacts import Store
from asia.ledger.chain import Chain
from asia.ledger.events import TestBands, TestedModel, Unsealed, Unsealing, Use
from asia.ledger.exports import write_exports
from asia.ledger.run import model_to_use, open_run
from asia.ledger.verification import check_lock, verify
from asia.ledger.view import Experiment, SearchView, replay
from asia.problem.load import load_lock
from asia.problem.metrics import MEE
from asia.problem.problem import Problem
from asia.problem.protocol import Block, whole
from asia.problem.seal import check_openable, open_test
from asia.search.run import LOCK, make_evaluator
from asia.search.simulation import (
    BAND_LEVEL,
    FinalMember,
    band_basis,
    final_members,
    has_model,
    models_behind,
)

Answers = tuple[Array, ...]

CONSENT = (
    "the candidates of run '{run}' ran at isolation level process, where a candidate can read "
    "every file that you can, the test data and their key included: the winner may have seen them"
)


@dataclass(frozen=True)
class UnsealResult:
    """The test result of a run."""

    record: Unsealed
    """The scores, as the ledger keeps them."""
    first_time: bool
    """False when this run had been unsealed before."""
    opened_before: tuple[str, ...]
    """Names of the other runs in the same folder that had opened the same test before."""


def unseal(
    directory: Path, *, process_consent: bool = False, keys: Path | None = None
) -> UnsealResult:
    """Score the ensemble of the winner's fold models, its refit and the stack on the sealed test.

    A second call returns the first result. A model that fails on the test is recorded as a Failure.

    Args:
        directory: run directory.
        process_consent: true to open the test although the candidates ran at level process;
            recorded.
        keys: folder of the key of an encrypted test; None for the user's own.

    Raises:
        UserError: the search is not finished, has no winner or no test, a line of the ledger or an
            artifact does not verify, problem or test data are not those of its first line, the key
            is missing, or the level is process without consent.
    """
    with Chain(directory / "ledger.jsonl") as chain:
        view = replay(line.event for line in chain.lines)
        if view.unsealed is not None:
            before = view.unsealing.opened_before if view.unsealing else ()
            return UnsealResult(view.unsealed, first_time=False, opened_before=before)
        best, digest = _check(directory, view)
        consented = process_consent and needs_consent(view)
        if needs_consent(view) and not consented:
            raise UserError(
                f"{CONSENT.format(run=view.started.run)}; to open the test nevertheless, "
                "give --yes-process (in Python: process_consent=True); the ledger records "
                "it"
            )
        verify(directory)
        problem = load_lock(directory / LOCK)
        check_openable(problem, keys)
        before = _openers(directory, digest)
        if view.unsealing is None:
            chain.append(Unsealing(best.number, digest, before, consented))
        event = _score(directory, view, best, problem, open_test(problem, keys))
        chain.append(event)
        write_exports(directory, replay(line.event for line in chain.lines))
    return UnsealResult(event, first_time=True, opened_before=before)


def needs_consent(view: SearchView) -> bool:
    """Return whether only the user can permit the opening of the test, because nothing kept the
    candidates of this search from reading it.
    """
    unopened = view.unsealing is None or not view.unsealing.process_consent
    open_levels = {level.isolation.value for level in LEVELS.values() if not level.confined}
    return unopened and view.started.isolation in open_levels


def _check(directory: Path, view: SearchView) -> tuple[Experiment, str]:
    """The winner and the digest of the test, when there is something to unseal."""
    check_lock(directory, view.started)
    run = view.started.run
    if not view.complete:
        raise UserError(f"run '{run}' is not finished: unsealing ends a search, finish it first")
    if view.best is None:
        raise UserError(f"run '{run}' has no scored model to unseal")
    if view.started.test_digest is None:
        raise UserError(f"problem '{view.started.problem}' has no test data")
    return view.best, view.started.test_digest


def _openers(directory: Path, digest: str) -> tuple[str, ...]:
    """Return the names of the other runs in the same folder that have opened the test."""
    names: list[str] = []
    for ledger in sorted(directory.parent.glob("*/ledger.jsonl")):
        if ledger.parent.name == directory.name:
            continue
        try:
            other = open_run(ledger.parent).view
        except UserError:
            continue
        if other.unsealing is not None and other.unsealing.test_digest == digest:
            names.append(ledger.parent.name)
    return tuple(names)


def _score(
    directory: Path,
    view: SearchView,
    best: Experiment,
    problem: Problem,
    records: tuple[Trajectory, ...],
) -> Unsealed:
    # The seal is on the records as they were measured, which `open_test` compares with the lock.
    digest = (problem.test.sha256 or "") if problem.preprocess else data_digest(records)
    if digest != view.started.test_digest:
        raise UserError(f"the test data are not those that run '{view.started.run}' had sealed")
    store = Store(directory / "artifacts")
    blocks = whole(records, problem.protocol)
    scorer = _TestScorer(make_evaluator(problem, view), store, blocks, problem)
    measured = _by_record([b.y for b in blocks], blocks)
    bands: TestBands | None = None
    failed: list[str] = []
    with scorer.evaluator.workers.ready_workers():
        scores = {
            use: scorer.score(final_members(view, use))
            for use in get_args(Use)
            if has_model(view, use)
        }
        with diagnostic("output bands", failed):
            bands = scorer.bands(view)
    return Unsealed(
        experiment=best.number,
        test_digest=digest,
        channels=tuple(s.name for s in problem.outputs),
        trajectories=tuple(r.name for r in records),
        lengths=tuple(len(y) for y in measured),
        skip=problem.protocol.test.skip,
        measured=store.put_arrays(measured),
        ensemble=scores["ensemble"],
        refit=scores.get("refit"),
        stack=scores.get("stack"),
        horizon=problem.protocol.horizon,
        bands=bands,
        failed_checks=tuple(failed),
    )


def _by_record(parts: Sequence[Array], blocks: Sequence[Block]) -> tuple[Array, ...]:
    """The parts of each test record, one for each block, one below the other."""
    records = dict.fromkeys(block.record for block in blocks)
    pairs = list(zip(parts, blocks, strict=True))
    return tuple(np.concatenate([p for p, block in pairs if block.record == r]) for r in records)


def _share(held: Mask, known: Mask) -> Array:
    """Return the share of measured samples (N, ny) in the held set, by output."""
    if known.all():
        return held.mean(axis=0)
    return (held & known).sum(axis=0) / np.maximum(known.sum(axis=0), 1)


@dataclass(frozen=True)
class _TestScorer:
    evaluator: Evaluator
    store: Store
    blocks: tuple[Block, ...]
    problem: Problem
    asked: dict[FinalMember, Sequence[Answers] | Failure] = field(
        default_factory=dict[FinalMember, "Sequence[Answers] | Failure"]
    )

    def score(self, members: Sequence[FinalMember]) -> TestedModel | Failure:
        """The score of the weighted mean of the members' simulations, or why there is none."""
        total: list[Array] = [np.zeros_like(block.y) for block in self.blocks]
        for member in members:
            answers = self._simulated(replace(member, weight=1.0))
            if isinstance(answers, Failure):
                return answers
            y_hat = mean_simulation(answers)
            total = [t + member.weight * one for t, one in zip(total, y_hat, strict=True)]
        try:
            return self._record(tuple(total))
        except CandidateError as error:
            return Failure(error.reason, error.detail)

    def bands(self, view: SearchView) -> TestBands | None:
        """The bands of the model to use, and how many of the measured samples they hold."""
        named = model_to_use(view)
        assert named is not None
        final = self._each(final_members(view, named.model))
        folds = self._each(models_behind(view, named.model))
        if final is None or folds is None:
            return None
        basis = band_basis(self.evaluator, view, self.store, named.model)
        found = [
            basis.around(block.case, each, mean.mean(axis=0), BAND_LEVEL)
            for block, each, mean in zip(self.blocks, folds, final, strict=True)
        ]
        lower, upper, outside = (
            _by_record(parts, self.blocks)
            for parts in (
                [bands.lower for bands, _ in found],
                [bands.upper for bands, _ in found],
                [out[:, None].astype(np.float64) for _, out in found],
            )
        )
        y = _by_record([b.y for b in self.blocks], self.blocks)
        skip = self.problem.protocol.test.skip
        held = [
            (low[skip:] <= one[skip:]) & (one[skip:] <= high[skip:])
            for one, low, high in zip(y, lower, upper, strict=True)
        ]
        known = ~np.isnan(np.concatenate([one[skip:] for one in y]))
        return TestBands(
            model=named.model,
            level=BAND_LEVEL,
            covered=tuple(_share(np.concatenate(held), known).tolist()),
            outside=float(np.concatenate([out[skip:] for out in outside]).mean()),
            lower=self.store.put_arrays(lower),
            upper=self.store.put_arrays(upper),
        )

    def _each(self, members: Sequence[FinalMember]) -> list[Array] | None:
        """Simulations (K, H, ny) of each block whose mean is that of the members; None where one
        fails."""
        total: list[Array] = [np.zeros((1, *block.y.shape)) for block in self.blocks]
        for member in members:
            answers = self._simulated(replace(member, weight=1.0))
            if isinstance(answers, Failure):
                return None
            parts = [np.stack(one) for one in zip(*answers, strict=True)]
            total = [t + member.weight * part for t, part in zip(total, parts, strict=True)]
        return total

    def _simulated(self, member: FinalMember) -> Sequence[Answers] | Failure:
        """Return the simulation of each of the member's models; each model is simulated once, even
        if several members contain it.
        """
        if member not in self.asked:
            source, models = self.store.text(member.source), map(self.store.get, member.models)
            try:
                each = self.evaluator.models.simulate_scored(source, list(models), self.blocks)
                self.asked[member] = _all_of(each)
            except CandidateError as error:
                self.asked[member] = Failure(error.reason, error.detail)
        return self.asked[member]

    def _record(self, y_hat: tuple[Array, ...]) -> TestedModel:
        rule, y = self.problem.protocol.test, [b.y for b in self.blocks]
        measured, simulated = (_by_record(parts, self.blocks) for parts in (y, y_hat))
        scores = tuple(
            score_test(measured, simulated, m, rule.skip) for m in rule.metrics if m != MEE
        )
        names = [s.name for s in self.problem.outputs]
        mee = None
        if MEE in rule.metrics:
            mee = mee_table(y, y_hat, names, rule.groups, rule.horizons)
        return TestedModel(scores, self.store.put_arrays(simulated), mee)


def _all_of(each: Sequence[Answers | CandidateError]) -> list[Answers]:
    """Raises the first error among the answers."""
    found: list[Answers] = []
    for one in each:
        if isinstance(one, CandidateError):
            raise one
        found.append(one)
    return found
