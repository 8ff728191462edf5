"""The first fit of an experiment between its end and its turn, on disk and back."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from asia.evaluation import Evaluation, FoldResult
from asia.ledger import FoldEvidence, Landed, Store, get_findings, put_findings
from asia.protocol import Fold
from asia.scoring import FoldScore, Score


def keep_folds(store: Store, folds: Sequence[FoldResult]) -> tuple[FoldEvidence, ...]:
    """Models, simulations and evidence as artifacts."""
    return tuple(_keep(store, fold) for fold in folds)


def _keep(store: Store, fold: FoldResult) -> FoldEvidence:
    return FoldEvidence(
        model=store.put(fold.model),
        y_hat=store.put_arrays(fold.y_hat),
        curve=store.put_arrays([fold.curve]),
        diagnostics=fold.diagnostics,
        fit_seconds=fold.seconds,
        validation_scores=fold.validation_scores,
        findings=put_findings(store, fold.findings) if fold.findings else None,
        machine=fold.machine,
        isolation=fold.isolation,
        device=fold.device,
    )


def keep_output(store: Store, output: str) -> str | None:
    """Store the output of a candidate as an artifact; return None for an empty output."""
    return store.put(output.encode()) if output else None


def landed_of(number: int, evaluation: Evaluation, seconds: float, store: Store) -> Landed:
    """The event, its artifacts kept."""
    return Landed(
        experiment=number,
        outcome=evaluation.outcome,
        folds=keep_folds(store, evaluation.folds),
        output=keep_output(store, evaluation.output),
        seconds=seconds,
        validation_scores=evaluation.validation_scores,
        ended_folds=evaluation.ended_folds,
    )


def evaluation_of(landed: Landed, folds: Sequence[Fold], store: Store) -> Evaluation:
    """The evaluation that was kept; folds: those of the problem. Raises UserError where an artifact
    is missing."""
    outcome = landed.outcome
    kept: tuple[FoldResult, ...] = ()
    if isinstance(outcome, Score):
        rows = zip(outcome.folds, landed.folds, folds, strict=True)
        kept = tuple(_taken_up(score, found, fold, store) for score, found, fold in rows)
    output = store.text(landed.output) if landed.output else ""
    return Evaluation(outcome, kept, output, landed.validation_scores, landed.ended_folds)


def _taken_up(score: FoldScore, kept: FoldEvidence, fold: Fold, store: Store) -> FoldResult:
    shapes = [block.y.shape for block in fold.validation]
    return FoldResult(
        score=score,
        model=store.get(kept.model),
        y_hat=store.get_arrays(kept.y_hat, shapes),
        curve=np.frombuffer(store.get(kept.curve), "<f8").reshape(-1, 2),
        diagnostics=kept.diagnostics,
        seconds=kept.fit_seconds,
        validation_scores=kept.validation_scores,
        findings=get_findings(store, kept.findings) if kept.findings else None,
        machine=kept.machine,
        isolation=kept.isolation,
        device=kept.device,
    )
