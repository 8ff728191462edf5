"""Fair trial of a candidate: what its recipe leaves open is chosen before it is scored.

One unlucky setting must not decide on an idea. The values of the setting that a family declares,
from stiff to free, and the linear model that it begins with, are fitted to a part of each fold's
own training records and simulated on the rest, `asia.problem.folds.inner_folds`. One choice is
made for all folds, from the errors of all of them: the simplest variant whose mean error is within
one standard error of the least (Breiman, Friedman, Olshen and Stone, Classification and Regression
Trees, 1984, section 3.4). Its source is the one that is scored, refitted and handed over.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import inf, sqrt
from statistics import fmean

import numpy as np

from asia.agents.library.recipe import read_recipe
from asia.agents.library.registry import family
from asia.agents.view import LINEAR
from asia.candidate import source_digest
from asia.errors import Reason
from asia.judge.evaluation import references
from asia.judge.evaluation.evaluator import Evaluator
from asia.judge.evaluation.results import Evaluation
from asia.ledger.events import Proposed, Variant
from asia.ledger.view import SearchView

PROPOSED = "as proposed"
"""Variant that is the candidate itself."""


@dataclass(frozen=True)
class Tried:
    """First fit of a candidate, after the choice of what it left open."""

    source: str
    """The source that was scored: the candidate's own, or a variant of it."""
    evaluation: Evaluation
    variants: tuple[Variant, ...] = ()
    """Variants that were compared, from simple to free; () where nothing was open."""

    @property
    def late(self) -> bool:
        """Whether the speed of the machine influenced the choice."""
        return any(v.failed and Reason(v.failed).status == "timeout" for v in self.variants)


def first_fit(
    evaluator: Evaluator, source: str, view: SearchView, proposed: Proposed | None = None
) -> Tried:
    """Choose what a candidate leaves open, then score it on every fold.

    Args:
        view: state of the search, whose reference is the linear variant
        proposed: record of the proposal; None where it is of no search
    """
    over = None if proposed is None else proposed.over
    fair = proposed is not None and proposed.fair and not _led(proposed, view)
    sources = variants_of(source, linear_source(view), fair=fair)
    variants = compared(evaluator, sources) if sources and evaluator.data.inner_folds else ()
    chosen = next((v for v in variants if v.chosen), None)
    if chosen is not None and chosen.name != LINEAR:
        orders = orders_of(sources[chosen.name])
        if orders:
            sources |= orders
            others = compared(evaluator, orders, {chosen.name: sources[chosen.name]})
            variants = *(replace(v, chosen=False) for v in variants if v is not chosen), *others
    source = next((sources[v.name] for v in variants if v.chosen), source)
    return Tried(source, evaluator.evaluate(source, over=over), variants)


def _led(proposed: Proposed, view: SearchView) -> bool:
    """Whether its parent is better than the linear model, so that it need not be compared again."""
    parent = None if proposed.parent is None else view.experiment(proposed.parent).value
    linear = view.reference_value(references.LINEAR_REFERENCE)
    return parent is not None and linear is not None and parent < linear


def linear_source(view: SearchView) -> str | None:
    """Source of the best linear model of a search; None where it has none."""
    if view.reference_value(references.LINEAR_REFERENCE) is None:
        return None
    name = references.LINEAR_REFERENCE
    return next(r.source or references.LINEAR for r in view.references if r.name == name)


def variants_of(source: str, linear: str | None, *, fair: bool = False) -> dict[str, str]:
    """Sources of the variants of a candidate, by name, from simple to free; none where it leaves
    nothing open, or is no recipe of the library.

    Args:
        linear: source of the linear model, the simplest variant of all families but those that
            are built on equations
        fair: whether it is compared with the linear model even if it leaves nothing open
    """
    recipe = read_recipe(source)
    row = None if recipe is None else family(recipe.family)
    if recipe is None or row is None:
        return {}
    found = {} if linear is None or row.kind == "equations" else {LINEAR: linear}
    if row.path is None or not row.path.is_open(recipe):
        own = linear is not None and source_digest(linear) == source_digest(source)
        return {**found, PROPOSED: source} if fair and found and not own else {}
    for value in row.path.values:
        title = f"{row.path.name} {value:g}"
        found[title] = recipe.configured(**{row.path.name: value}).source(f"{row.label}, {title}")
    return found


def orders_of(source: str) -> dict[str, str]:
    """Sources of a chosen variant with the numbers of states of its family, from simple to free;
    none where it states the number."""
    recipe = read_recipe(source)
    row = None if recipe is None else family(recipe.family)
    if recipe is None or row is None or recipe.get("order"):
        return {}
    return {
        f"order {n}": recipe.configured(order=n).source(f"{row.label}, order {n}")
        for n in row.orders
    }


def compared(
    evaluator: Evaluator, sources: Mapping[str, str], chosen: Mapping[str, str] | None = None
) -> tuple[Variant, ...]:
    """Fit variants on the inner folds, from simple to free until their error rose twice, and choose
    one.

    Args:
        chosen: what was chosen before, as the last variant
    """
    errors: list[tuple[float, ...] | Reason] = []
    means, rises = list[float](), 0
    for source in sources.values():
        errors.append(evaluator.inner_errors(source))
        means.append(inf if isinstance(errors[-1], Reason) else fmean(errors[-1]))
        rises += len(means) > 1 and means[-1] >= means[-2]
        if rises == 2:
            break
    names = list(sources)[: len(errors)]
    for name, source in (chosen or {}).items():
        names.append(name)
        errors.append(evaluator.inner_errors(source))
    return chosen_of(names, errors)


def chosen_of(
    names: Sequence[str], errors: Sequence[tuple[float, ...] | Reason]
) -> tuple[Variant, ...]:
    """Choose the first variant that is behind the best by no more than one standard error.

    It is that of the paired difference, or that of the best variant's error if this is smaller: a
    variant that diverges in a single part has a difference as large as its standard error.

    Args:
        names: of the variants, from simple to free
        errors: of each on the same parts of held-out records, or why it failed
    """
    known = {i: np.array(e) for i, e in enumerate(errors) if not isinstance(e, Reason)}
    if not known:
        return ()
    best = min(known.values(), key=lambda e: float(e.mean()))
    behind = {i: e - best for i, e in known.items()}
    deviation = {
        i: min(float(values.std(ddof=1)) for values in (d, best)) / sqrt(len(d))
        if len(d) > 1
        else 0.0
        for i, d in behind.items()
    }
    chosen = min(i for i, d in behind.items() if d.mean() <= deviation[i])
    return tuple(
        Variant(name, failed=error.value)
        if isinstance(error, Reason)
        else Variant(name, fmean(error), "", float(behind[i].mean()), deviation[i], i == chosen)
        for i, (name, error) in enumerate(zip(names, errors, strict=True))
    )
