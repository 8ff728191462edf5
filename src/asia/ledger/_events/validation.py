"""The dossier of a finished model: what each check said."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from asia.ledger._events.final import Use
from asia.scoring.dossier import Verdict


@dataclass(frozen=True)
class RecordedCheck:
    """One check of a validation report, as it was printed."""

    name: str
    """A few words, unique within a dossier."""
    verdict: Verdict
    """Result of the check."""
    sentence: str
    """Finding, with numbers."""
    cause: str = ""
    """Probable cause; "" if none is named."""
    weight: float = 0.0
    """Importance among the checks that do not pass."""


@dataclass(frozen=True)
class Validated:
    """All checks of the model to use."""

    experiment: int
    """The winner of the search, 1-based."""
    model: Use
    """Final model that was checked."""
    record: str
    """The new record that was simulated; "" for what the folds held out."""
    record_digest: str
    """Digest of that record; "" without one."""
    checks: tuple[RecordedCheck, ...]
    """Checks in reading order."""
    curves: str
    """Artifact with what the checks draw."""
    passed: int
    """Checks that pass."""
    doubtful: int
    """Checks in doubt."""
    failed: int
    """Checks that fail."""
    worst: str = ""
    """The check to look at first; "" where all pass."""
    after_unsealing: bool = False
    """True if the sealed test had been opened before."""
    event: Literal["validated"] = "validated"


def with_dossier(known: tuple[Validated, ...], new: Validated) -> tuple[Validated, ...]:
    """The last dossier on each record, that on what the folds held out first."""
    others = tuple(one for one in known if one.record_digest != new.record_digest)
    return (*others, new) if new.record else (new, *others)
