"""The findings of each fold, as artifacts of a run."""

from __future__ import annotations

from dataclasses import replace

from pydantic import TypeAdapter, ValidationError

from asia.errors import UserError
from asia.evaluation import FoldFindings
from asia.ledger._store import Store
from asia.ledger._view import Experiment

_FINDINGS: TypeAdapter[FoldFindings] = TypeAdapter(FoldFindings)


def put_findings(store: Store, findings: FoldFindings) -> str:
    """Keep them; the name of the artifact."""
    return store.put(_FINDINGS.dump_json(findings))


def get_findings(store: Store, name: str) -> FoldFindings:
    """Those of an artifact. Raises UserError where it is missing or this version cannot read it."""
    try:
        return _FINDINGS.validate_json(store.get(name))
    except ValidationError:
        raise UserError(
            f"artifact {name} was written by another version of ASIA: read it with that one"
        ) from None


def findings_of(store: Store, experiment: Experiment, *, bounded: bool) -> tuple[FoldFindings, ...]:
    """Return the findings of each fold; () for a failure and in older ledgers.

    Held-out errors are left out if the experiment shows no score of its folds: an agent must not
    learn the degree to which a candidate was found suspect.

    Args:
        store: artifacts of the run.
        experiment: the experiment.
        bounded: true if the reader sees only the scores that the Ladder reports. Texts that a
            candidate controls, its prints and the names and values of its parameters, are left out
            then, because they could carry records.
    """
    result, score = experiment.result, experiment.score
    names = [fold.findings for fold in result.folds] if result else []
    found = [get_findings(store, name) for name in names if name is not None]
    if score is None or not score.folds:
        found = [replace(one, errors=(), steps=(), held_out_residuals=()) for one in found]
    if bounded:
        found = [replace(one, parameters=(), printed="", failed=()) for one in found]
    return tuple(found)
