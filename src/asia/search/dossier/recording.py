"""Keep a dossier in the ledger of a finished search."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from asia._text import one_line
from asia.data import Trajectory, data_digest
from asia.ledger import Chain, RecordedCheck, SearchView, Store, Use, Validated, put_curves
from asia.scoring.dossier import Check, Verdict, most_serious

# A line of the ledger has room for all checks of a dossier.
_LONGEST = 2000


def record_dossier(
    directory: Path,
    model: Use,
    records: Sequence[Trajectory],
    name: str,
    checks: Sequence[Check],
) -> bool:
    """Append what the checks say of the winner and its model to use; False where the ledger says so
    already. Raises UserError when another process holds the ledger."""
    store = Store(directory / "artifacts")
    curves = put_curves(store, checks)
    with Chain(directory / "ledger.jsonl") as chain:
        event = _event(chain.view, model, records, name, checks, curves)
        if event in chain.view.validated:
            return False
        chain.append(event)
        return True


def _event(
    view: SearchView,
    model: Use,
    records: Sequence[Trajectory],
    name: str,
    checks: Sequence[Check],
    curves: str,
) -> Validated:
    assert view.best is not None
    worst = most_serious(tuple(checks))
    counts = [sum(c.verdict is v for c in checks) for v in Verdict]
    numbers = dict(zip(Verdict, counts, strict=True))
    return Validated(
        experiment=view.best.number,
        model=model,
        record=name,
        record_digest=data_digest(records) if records else "",
        checks=tuple(
            RecordedCheck(
                one.name,
                one.verdict,
                one_line(one.sentence, _LONGEST),
                "" if one.cause is None else str(one.cause),
                round(one.weight, 4),
            )
            for one in checks
        ),
        curves=curves,
        passed=numbers[Verdict.PASS],
        doubtful=numbers[Verdict.DOUBT],
        failed=numbers[Verdict.FAIL],
        worst="" if worst is None else worst.name,
        after_unsealing=view.unsealing is not None,
    )
