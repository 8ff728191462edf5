"""The winner with parts taken back, fitted again, and what the gain is due to."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from asia.scoring import Attribution, Interval


@dataclass(frozen=True)
class AblationFit:
    """A variant of the winner fitted on every fold, from a seed that the evaluator chose."""

    variant: str
    """Description of the variant."""
    source: str
    """Artifact of its `candidate.py`."""
    digest: str
    """Digest of its normalised AST."""
    repeat: int
    """Number of the seed, 1-based, the same for all variants."""
    value: float | None = None
    """V of the fits; None where one failed."""
    folds: tuple[float, ...] = ()
    """Its part of each fold; () where one failed."""
    failed: str = ""
    """The reason of the failure."""
    seconds: float = 0.0
    """Duration."""
    event: Literal["ablation_fit"] = "ablation_fit"


@dataclass(frozen=True)
class LeftOut:
    """The winner without what one experiment of its lineage changed."""

    experiment: int
    """The experiment that brought the change."""
    loss: Interval | None = None
    """Increase of V without the change, with a 95 % interval over the seeds; None if not known."""
    detail: str = ""
    """Why it is not known."""


@dataclass(frozen=True)
class Ablated:
    """Contributions of the changes to the gain of a search."""

    winner: int
    """The incumbent of the search."""
    baseline: int
    """The experiment that it is compared with."""
    seeds: int
    """Fits of a variant that depends on the seed."""
    crossing: Attribution | None
    """Model and training of the two crossed; None where that cannot be had."""
    detail: str
    """Why it cannot."""
    left_out: tuple[LeftOut, ...] = ()
    """Each change of the lineage, the first one first."""
    event: Literal["ablated"] = "ablated"
