"""Agreement and disagreement between the folds of one experiment."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from statistics import fmean

from asia.evaluation import FoldFindings
from asia.scoring import Evidence, PartKind, SignedResidual

LARGEST_SPREAD = 0.5
"""Over the mean of the folds: what lies further apart disagrees."""


@dataclass(frozen=True)
class ParameterSpread:
    """A named parameter in all folds."""

    name: str
    """Its name, the model's word."""
    values: tuple[float, ...]
    """Value in each fold."""

    @property
    def spread(self) -> float:
        """Largest less smallest value over the size of their mean."""
        mean = abs(fmean(self.values))
        apart = max(self.values) - min(self.values)
        if mean > 0:
            return apart / mean
        return float("inf") if apart > 0 else 0.0

    @property
    def changes_sign(self) -> bool:
        """Return whether the folds disagree on the sign."""
        return min(self.values) < 0 < max(self.values)

    @property
    def disagrees(self) -> bool:
        """Return whether the folds found significantly different values: the model is wrong there,
        or the records do not determine it.
        """
        return self.changes_sign or self.spread > LARGEST_SPREAD


def parameter_spreads(folds: Sequence[FoldFindings]) -> tuple[ParameterSpread, ...]:
    """Return the spread of each parameter that all folds name, largest disagreement first."""
    tables = [dict(one.parameters) for one in folds]
    names = [n for n in (tables[0] if tables else {}) if all(n in table for table in tables)]
    found = [ParameterSpread(name, tuple(table[name] for table in tables)) for name in names]
    return tuple(sorted(found, key=lambda one: -one.spread))


@dataclass(frozen=True)
class SharedResidual:
    """The mean residual over one part of the data, in all folds together."""

    residual: SignedResidual
    """Its mean over the folds that have this part, with the standard error of that mean."""
    folds: tuple[int, ...]
    """The folds whose own mean lies on the same side by more than its standard error, from 1."""
    share: float
    """The share of the squared residual of its output that would be gone without it, mean over all
    folds."""
    gain: float
    """The same in squared standard deviations, by which outputs compare."""

    @property
    def evidence(self) -> Evidence:
        """Relevance by the rule for a single fold."""
        return self.residual.evidence


def shared_residuals(
    folds: Sequence[Sequence[SignedResidual]],
) -> tuple[SharedResidual, ...]:
    """Return the signed residuals that exceed the noise in all folds together.

    Significant residuals come before those that may be chance, then the largest gain first.
    """
    found: defaultdict[tuple[int, PartKind, int, int], list[tuple[int, SignedResidual]]]
    found = defaultdict(list)
    for number, fold in enumerate(folds, 1):
        for one in fold:
            found[one.output, one.kind, one.signal, one.part].append((number, one))
    shared = (_shared(ones, len(folds)) for ones in found.values())
    kept = [one for one in shared if one.evidence is not Evidence.NONE]
    return tuple(sorted(kept, key=lambda one: (one.evidence is Evidence.CHANCE, -one.gain)))


def _shared(ones: Sequence[tuple[int, SignedResidual]], folds: int) -> SharedResidual:
    first = ones[0][1]
    mean = fmean(one.mean for _, one in ones)
    error = math.sqrt(sum(one.error**2 for _, one in ones)) / len(ones)
    agree = tuple(number for number, one in ones if one.mean * mean > abs(mean) * one.error)
    share, gain = (sum(values) / folds for values in zip(*_weights(ones), strict=True))
    residual = replace(first, mean=mean, error=error, share=share, gain=gain)
    return SharedResidual(residual, agree, share, gain)


def _weights(ones: Sequence[tuple[int, SignedResidual]]) -> list[tuple[float, float]]:
    return [(one.share, one.gain) for _, one in ones]
