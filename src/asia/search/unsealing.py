"""Open the sealed test, once, and say how the search's best candidate does on it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import get_args

import numpy as np

from asia._diagnostic import diagnostic
from asia._progress import tracked
from asia.data.segment import Segment
from asia.data.trajectory import Array, Trajectory, data_digest
from asia.errors import CandidateError, Reason, UserError
from asia.judge.evaluation.evaluator import Evaluator
from asia.judge.sandbox.levels import LEVELS
from asia.judge.sandbox.types import Isolation
from asia.judge.scoring.outcome import Failure, mean_simulation, score_fold
from asia.ledger.artifacts import Store
from asia.ledger.chain import Chain
from asia.ledger.events import TestBands, TestedModel, Unsealed, Unsealing, Use
from asia.ledger.looks import record_look
from asia.ledger.run import model_to_use
from asia.ledger.verification import check_lock, verify
from asia.ledger.view import Experiment, SearchView
from asia.presentation.exports import write_exports
from asia.problem.folds import whole
from asia.problem.load import load_lock
from asia.problem.problem import Problem
from asia.problem.seal import check_openable, open_test
from asia.search.run import LOCK, level_here, make_evaluator
from asia.search.scores import ScoreCheck, by_record, score_sealed
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
    "the candidates of run '{run}' run at isolation level process, where a candidate can read "
    "every file that you can, the test data and their key included: the best candidate may have "
    "seen them"
)


@dataclass(frozen=True)
class UnsealResult:
    """The test result of a run."""

    record: Unsealed
    first_time: bool
    """False when this run had been unsealed before."""
    opened_before: tuple[str, ...]
    """The looks at the same test before that this user's folder and the neighbours of the run know,
    with the time."""


def unseal(
    directory: Path,
    *,
    process_consent: bool = False,
    keys: Path | None = None,
    isolation: Isolation | None = None,
) -> UnsealResult:
    """Score the ensemble of the best candidate's fold models, its refit and the stack on the
    sealed test.

    A second call returns the first result. A model that fails on the test is recorded as a Failure.

    Args:
        process_consent: true to open the test although the candidates ran at level process;
            recorded.
        keys: folder of the key of an encrypted test; None for the user's own.
        isolation: level of the candidates while they simulate the test; None for the strongest of
            this machine.

    Raises:
        UserError: the search is not finished, has no best candidate or no test, a line of the
        ledger or an
            artifact does not verify, problem or test data are not those of its first line, the key
            is missing, the level is process without consent, or a copy of the run opened the test.
    """
    with Chain(directory / "ledger.jsonl") as chain:
        view = chain.view
        if view.unsealed is not None:
            before = view.unsealing.opened_before if view.unsealing else ()
            return UnsealResult(view.unsealed, first_time=False, opened_before=before)
        check_lock(directory, view.started)
        run, best, digest = view.started.run, view.best, view.started.test_digest
        if not view.complete:
            raise UserError(
                f"run '{run}' is not finished: unsealing ends a search, finish it first"
            )
        if best is None:
            raise UserError(f"run '{run}' has no scored model to unseal")
        if digest is None:
            raise UserError(f"problem '{view.started.problem}' has no test data")
        level = level_here(isolation)
        consented = process_consent and needs_consent(view, level)
        if needs_consent(view, level) and not consented:
            raise UserError(
                f"{CONSENT.format(run=run)}; to open the test nevertheless, give --yes-process "
                "(in Python: process_consent=True); the ledger records it"
            )
        problem = load_lock(directory / LOCK)
        verify(directory, check=ScoreCheck(directory, problem))
        check_openable(problem, keys)
        if view.unsealing is None:
            # In this order a crash between the two hides no look.
            before = record_look(digest, directory)
            chain.append(Unsealing(best.number, digest, before, consented))
        else:
            before = view.unsealing.opened_before
        evaluator = make_evaluator(problem, view, isolation=level, controllers=True)
        event = _score(directory, view, best, evaluator, problem, open_test(problem, keys))
        chain.append(event)
        write_exports(directory, chain.view)
    return UnsealResult(event, first_time=True, opened_before=before)


def needs_consent(view: SearchView, level: Isolation | None = None) -> bool:
    """Return whether the user must permit the opening, as candidates could read the test: in the
    search, or at the `level` that they run at now."""
    unopened = view.unsealing is None or not view.unsealing.process_consent
    open_levels = {level.isolation.value for level in LEVELS.values() if not level.confined}
    return unopened and not open_levels.isdisjoint({view.started.isolation, level})


def _score(
    directory: Path,
    view: SearchView,
    best: Experiment,
    evaluator: Evaluator,
    problem: Problem,
    records: tuple[Trajectory, ...],
) -> Unsealed:
    # The seal is on the records as they were measured, which `open_test` compares with the lock.
    digest = (problem.test.sha256 or "") if problem.preprocess else data_digest(records)
    if digest != view.started.test_digest:
        raise UserError(f"the test data are not those that run '{view.started.run}' had sealed")
    store = Store(directory / "artifacts")
    blocks = whole(records, problem.protocol)
    scorer = _TestScorer(evaluator, store, blocks, problem)
    measured = by_record([b.y for b in blocks], blocks)
    bands: TestBands | None = None
    failed: list[str] = []
    with scorer.evaluator.workers.ready_workers():
        each = {
            use: final_members(view, use)
            for use in get_args(Use)
            if has_model(view, use) and (problem.control is None or use == "refit")
        }
        scorer.simulate([member for members in each.values() for member in members])
        scores = {use: scorer.score(members) for use, members in each.items()}
        if problem.control is not None:
            scores["ensemble"] = Failure(
                Reason.CONTRACT, "the mean of several closed loops is no closed loop"
            )
        else:
            with diagnostic("output bands", failed):
                bands = scorer.bands(view, failed)
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


@dataclass(frozen=True)
class _TestScorer:
    evaluator: Evaluator
    store: Store
    blocks: tuple[Segment, ...]
    problem: Problem
    simulated: dict[FinalMember, Sequence[Answers] | Failure] = field(
        default_factory=dict[FinalMember, "Sequence[Answers] | Failure"]
    )

    def score(self, members: Sequence[FinalMember]) -> TestedModel | Failure:
        """The score of the weighted mean of the members' simulations, or why there is none."""
        total: list[Array] = [np.zeros_like(block.y) for block in self.blocks]
        for member in tracked(members, "model"):
            answers = self._simulated(replace(member, weight=1.0))
            if isinstance(answers, Failure):
                return answers
            y_hat = mean_simulation(answers)
            total = [t + member.weight * one for t, one in zip(total, y_hat, strict=True)]
        y = [b.y for b in self.blocks]
        measured, simulated = (by_record(parts, self.blocks) for parts in (y, total))
        skip = self.problem.protocol.test.skip
        try:
            scores, mee = score_sealed(self.problem, measured, simulated)
        except CandidateError as error:
            return Failure(error.reason, error.detail)
        error = score_fold(
            [part[skip:] for part in measured], [part[skip:] for part in simulated],
            self.evaluator.data.scale, self.problem.protocol.metric,
        ).value  # fmt: skip
        return TestedModel(scores, self.store.put_arrays(simulated), mee, error)

    def bands(self, view: SearchView, notes: list[str]) -> TestBands | None:
        """The bands of the model to use, and how many of the measured samples they hold; None with
        a note where the band of an output is withdrawn."""
        named = model_to_use(view)
        assert named is not None
        final = self._each_simulation(final_members(view, named.model))
        folds = self._each_simulation(models_behind(view, named.model))
        if final is None or folds is None:
            return None
        basis = band_basis(self.evaluator, view, self.store, named.model)
        for output, reason in zip(self.problem.outputs, basis.calibration.withdrawn, strict=True):
            if reason:
                notes.append(f"output bands of {output.name} are withdrawn: {reason}")
                return None
        lows: list[Array] = []
        highs: list[Array] = []
        outsides: list[Array] = []
        for block, each, mean in zip(self.blocks, folds, final, strict=True):
            found, out = basis.around(block, each, mean.mean(axis=0), BAND_LEVEL)
            lows.append(found.lower)
            highs.append(found.upper)
            outsides.append(out[:, None].astype(np.float64))
        y, lower, upper, outside = (
            by_record(parts, self.blocks)
            for parts in ([b.y for b in self.blocks], lows, highs, outsides)
        )
        skip = self.problem.protocol.test.skip
        scored, low, high = (np.concatenate([one[skip:] for one in p]) for p in (y, lower, upper))
        # The comparison with an unmeasured output, NaN, is false.
        held = ((low <= scored) & (scored <= high)).sum(axis=0)
        measured = (~np.isnan(scored)).sum(axis=0)
        return TestBands(
            model=named.model,
            level=BAND_LEVEL,
            covered=tuple((held / np.maximum(measured, 1)).tolist()),
            outside=float(np.concatenate([out[skip:] for out in outside]).mean()),
            lower=self.store.put_arrays(lower),
            upper=self.store.put_arrays(upper),
        )

    def _each_simulation(self, members: Sequence[FinalMember]) -> list[Array] | None:
        """Simulations (K, H, ny) of each block with the members' mean; None where one fails."""
        total: list[Array] = [np.zeros((1, *block.y.shape)) for block in self.blocks]
        for member in tracked(members, "model"):
            answers = self._simulated(replace(member, weight=1.0))
            if isinstance(answers, Failure):
                return None
            parts = [np.stack(one) for one in zip(*answers, strict=True)]
            total = [t + member.weight * part for t, part in zip(total, parts, strict=True)]
        return total

    def _simulated(self, member: FinalMember) -> Sequence[Answers] | Failure:
        """The simulation of each of the member's models, made once."""
        if member not in self.simulated:
            self.simulate([member])
        return self.simulated[member]

    def simulate(self, members: Sequence[FinalMember]) -> None:
        """Simulate the models of several members side by side."""
        new = dict.fromkeys(replace(member, weight=1.0) for member in members)
        new = [member for member in new if member not in self.simulated]
        jobs = [(m, self.store.text(m.source), key) for m in new for key in m.models]
        try:
            found = self.evaluator.models.simulate_scored(
                [(source, self.store.get(key)) for _, source, key in jobs], self.blocks
            )
        except CandidateError as error:
            found = [error] * len(jobs)
        for member in new:
            answers: list[Answers] = []
            for (own, *_), one in zip(jobs, found, strict=True):
                if own is not member:
                    continue
                if isinstance(one, CandidateError):
                    self.simulated[member] = Failure(one.reason, one.detail)
                    break
                answers.append(one)
            else:
                self.simulated[member] = answers
