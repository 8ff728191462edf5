"""Open the sealed test, once, and say how the search's winner does on it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from asia.errors import UserError
from asia.evaluation import Evaluator
from asia.ledger import Chain, Experiment, Store, TestRecord, Unsealed, replay, write_exports
from asia.problem import Array, ProtocolRule
from asia.problem.load import load_lock
from asia.protocol import Block, whole
from asia.protocol._sealed import open_test
from asia.scoring import score_test
from asia.search._search import LOCK, make_evaluator


@dataclass(frozen=True)
class UnsealResult:
    """The test result; `first_time` is False when it had been opened before."""

    record: Unsealed
    first_time: bool


def unseal(directory: Path) -> UnsealResult:
    """Score the ensemble of the winner's fold models, and its refit, on the sealed test.

    A second call returns the first result. Raises UserError when the search is not finished, has
    no winner or no test, or when the test data are not those sealed before experiment 1.
    """
    with Chain(directory / "ledger.jsonl") as chain:
        view = replay(line.event for line in chain.lines)
        if view.unsealed is not None:
            return UnsealResult(view.unsealed, first_time=False)
        run = view.started.run
        if view.stopped is None:
            raise UserError(
                f"run '{run}' is not finished: unsealing ends a search, finish it first"
            )
        best = view.best
        if best is None:
            raise UserError(f"run '{run}' has no scored model to unseal")
        if view.started.test_digest is None:
            raise UserError(f"problem '{view.started.problem}' has no test data")
        problem = load_lock(directory / LOCK)
        store = Store(directory / "artifacts")
        evaluator = make_evaluator(problem, view)
        records = open_test(problem)
        blocks = whole(records, problem.protocol)
        ensemble = _simulate(evaluator, store, best, _fold_models(best), blocks)
        refitted = view.refitted.model if view.refitted else None
        refit = _simulate(evaluator, store, best, (refitted,), blocks) if refitted else None
        rule = problem.protocol
        event = Unsealed(
            experiment=best.number,
            test_digest=view.started.test_digest,
            channels=tuple(s.name for s in problem.outputs),
            trajectories=tuple(r.name for r in records),
            lengths=tuple(len(b.y) for b in blocks),
            skip=rule.test.skip,
            measured=store.put_arrays([b.y for b in blocks]),
            ensemble=_record(store, blocks, ensemble, rule),
            refit=_record(store, blocks, refit, rule) if refit else None,
        )
        chain.append(event)
        write_exports(directory, replay(line.event for line in chain.lines))
    return UnsealResult(event, first_time=True)


def _fold_models(best: Experiment) -> tuple[str, ...]:
    assert best.result is not None
    return tuple(fold.model for fold in best.result.folds)


def _simulate(
    evaluator: Evaluator,
    store: Store,
    best: Experiment,
    models: tuple[str, ...],
    blocks: tuple[Block, ...],
) -> tuple[Array, ...]:
    """Mean over the models of their simulations, one (H, ny) array a block."""
    source = store.text(best.proposed.source)
    each = evaluator.simulate(source, [store.get(m) for m in models], blocks)
    return tuple(np.mean(np.stack(parts), axis=0) for parts in zip(*each, strict=True))


def _record(
    store: Store, blocks: tuple[Block, ...], y_hat: tuple[Array, ...], rule: ProtocolRule
) -> TestRecord:
    measured = [b.y for b in blocks]
    scores = tuple(score_test(measured, y_hat, m, rule.test.skip) for m in rule.test.metrics)
    return TestRecord(scores, store.put_arrays(y_hat))
