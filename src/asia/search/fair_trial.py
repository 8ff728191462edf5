"""Fair trial of a candidate: what its recipe leaves open is chosen before it is scored.

One unlucky setting must not decide on an idea. The values of the setting that a family declares,
from stiff to free, and what it begins with, its parent or the linear model, are fitted to a part of
each fold's own training records and simulated on the rest, `asia.problem.folds.inner_folds`. One
choice is made for all folds, from the errors of all of them: the linear model where it is within
one standard error of the least error (Breiman, Friedman, Olshen and Stone, Classification and
Regression Trees, 1984, section 3.4), else the least. Its source is scored, refitted and handed
over.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import inf, sqrt
from statistics import fmean
from typing import TypeVar

import numpy as np

from asia.agents.registry import library_candidate
from asia.agents.view import LINEAR, PARENT
from asia.candidate import Context, source_digest
from asia.data.statistics import undecided_inputs
from asia.data.trajectory import INTERSAMPLE, Array
from asia.errors import Reason, UserError
from asia.judge.evaluation import references
from asia.judge.evaluation.evaluator import Evaluation, EvaluationData, Evaluator
from asia.ledger.artifacts import Store
from asia.ledger.events import Evaluated, Landed, Proposed, Variant
from asia.ledger.view import Experiment, SearchView
from asia.problem.memory import delays_signals
from asia.problem.physics_text import read_physics
from asia.recipe import EQUATIONS, Recipe, read_recipe, with_chosen_equations

_Key = TypeVar("_Key")
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
    evaluator: Evaluator,
    source: str,
    view: SearchView,
    proposed: Proposed | None = None,
    store: Store | None = None,
) -> Tried:
    """Choose what a candidate leaves open, then score it on every fold.

    Args:
        view: state of the search, with what the candidate begins with
        proposed: record of the proposal; None where it is of no search
        store: artifacts of the search
    """
    fair = proposed is not None and proposed.fair
    begins, parent = _begins_with(view, proposed, store), _parent(view, proposed)
    if parent is not None and store is not None:
        source = with_inputs_of(source, store.text(parent.source), evaluator.data.context)
    sources, variants = choice(evaluator, source, begins, fair=fair)
    source = next((sources[v.name] for v in variants if v.chosen), source)
    if begins.get(PARENT) == source and parent is not None and parent.result and store is not None:
        return Tried(source, evaluation_of(parent.result, store), variants)
    return Tried(source, evaluator.evaluate(source), variants)


def choice(
    evaluator: Evaluator, source: str, begins: Mapping[str, str], *, fair: bool = False
) -> tuple[dict[str, str], tuple[Variant, ...]]:
    """Sources of the variants of a candidate, and their comparison: first those of its inputs
    between samples, then the others. The arguments are those of `variants_of`."""
    between, inputs = variants_between(source, evaluator.data), tuple[Variant, ...]()
    if between and evaluator.data.inner_folds:
        inputs = compared(evaluator, between, rises=1)
        source = next((between[v.name] for v in inputs if v.chosen), source)
    sources, variants = _other_choice(evaluator, source, begins, fair=fair)
    if not any(v.chosen for v in variants):
        return between, inputs
    earlier = (replace(v, chosen=False) for v in inputs)
    return {**between, **sources}, (*earlier, *variants)


def with_inputs_of(source: str, parent: str, context: Context) -> str:
    """Source with the inputs between samples as its parent has them, where it leaves them open."""
    recipe, other = _open_between(source, context), read_recipe(parent)
    stated = None if other is None else other.get("intersample")
    if recipe is None or stated is None:
        return source
    return recipe.configured(intersample=stated).source("inputs as in its parent")


def variants_between(source: str, data: EvaluationData) -> dict[str, str]:
    """Sources with each behaviour of the inputs between samples, by name; none where the candidate
    states one, its family has none or delays signals, or the problem file and the records
    decide."""
    recipe = _open_between(source, data.context)
    if recipe is None or not undecided_inputs(data.context.inputs, data.records):
        return {}
    regular = not any(signal.role == "time_step" for signal in data.context.inputs)
    titles = {
        f"inputs {text} between samples": kind
        for kind, text in INTERSAMPLE.items()
        if regular or kind != "band_limited"
    }
    return {
        title: recipe.configured(intersample=kind).source(title) for title, kind in titles.items()
    }


def _open_between(source: str, context: Context) -> Recipe | None:
    """A candidate that leaves open how its inputs move between samples."""
    known = library_candidate(source)
    if known is None:
        return None
    recipe, row = known
    held = "physics" in row.needs and _needs_held(recipe, context)
    return recipe if row.intersample and not recipe.has("intersample") and not held else None


def _needs_held(recipe: Recipe, context: Context) -> bool:
    """Whether equations of a candidate delay signals, so that its inputs are held."""
    texts = recipe.get("physics")
    try:
        found = [read_physics(str(t)) for t in texts] if isinstance(texts, tuple) else []
        if not found and context.physics is not None:
            found = [context.physics]
        return any(map(delays_signals, found))
    except UserError:
        # The fit says what is wrong.
        return True


def _other_choice(
    evaluator: Evaluator, source: str, begins: Mapping[str, str], *, fair: bool
) -> tuple[dict[str, str], tuple[Variant, ...]]:
    sources = variants_of(source, begins, fair=fair)
    # Equations come in no order.
    whole = any(name.startswith(EQUATIONS) for name in sources)
    possible = sources and evaluator.data.inner_folds
    variants = compared(evaluator, sources, rises=len(sources) if whole else 2) if possible else ()
    if any(v.error and v.behind <= v.deviation and v.name not in begins for v in variants):
        finer = variants_of(source, begins, fair=fair, values=finer_path(source, variants))
        if finer.keys() - sources.keys():
            sources, variants = finer, compared(evaluator, finer, rises=len(finer))
    return sources, variants


def evaluation_of(result: Landed | Evaluated, store: Store) -> Evaluation:
    """The evaluation that was recorded. Raises UserError where its output is missing."""
    folds = tuple(fold.loaded(store) for fold in result.folds)
    return Evaluation(
        replace(result.outcome, folds=folds),
        store.text(result.output) if result.output else "",
        result.validation_scores,
        store,
    )


def _begins_with(
    view: SearchView, proposed: Proposed | None, store: Store | None
) -> dict[str, str]:
    """The simplest variant of a candidate: its parent where this is better than the linear model,
    else the linear model; {} where there is neither."""
    parent, linear = _parent(view, proposed), view.reference_value(references.LINEAR_REFERENCE)
    value = None if parent is None else parent.value
    leads = value is not None and (linear is None or value < linear)
    if leads and parent is not None and store is not None:
        return {PARENT: store.text(parent.source)}
    source = linear_source(view)
    return {} if source is None else {LINEAR: source}


def _parent(view: SearchView, proposed: Proposed | None) -> Experiment | None:
    number = None if proposed is None else proposed.parent
    return None if number is None else view.experiment(number)


def linear_source(view: SearchView) -> str | None:
    """Source of the best linear model of a search; None where it has none."""
    if view.reference_value(references.LINEAR_REFERENCE) is None:
        return None
    name = references.LINEAR_REFERENCE
    return next(r.source or references.LINEAR for r in view.references if r.name == name)


def variants_of(
    source: str,
    begins: Mapping[str, str],
    *,
    fair: bool = False,
    values: Sequence[float] | None = None,
) -> dict[str, str]:
    """Sources of the variants of a candidate, by name, from simple to free; none where it leaves
    nothing open, or is no recipe of the library.

    Args:
        begins: the simplest variant, of all families but those that are built on equations of the
            problem
        fair: whether it is compared with that even if it leaves nothing open
        values: of the path, None for those of the family
    """
    known = library_candidate(source)
    if known is None:
        return {}
    recipe, row = known
    equations = recipe.get("physics")
    # Equations of the user's own are tried all the same.
    found = {} if row.kind == "equations" and not equations else dict(begins)
    if isinstance(equations, tuple) and len(equations) > 1:
        for number in range(1, len(equations) + 1):
            title = f"{EQUATIONS} {number}"
            found[title] = with_chosen_equations(recipe, title).source(f"{row.label}, {title}")
        return found
    if row.path is None or not row.path.is_open(recipe):
        own = any(source_digest(one) == source_digest(source) for one in begins.values())
        return {**found, PROPOSED: source} if fair and found and not own else {}
    for value in row.path.values if values is None else values:
        title = f"{row.path.name} {value:g}"
        found[title] = recipe.configured(**{row.path.name: value}).source(f"{row.label}, {title}")
    return found


def finer_path(source: str, variants: Sequence[Variant]) -> tuple[float, ...]:
    """Values of the path that were compared, and one midway between the best and the better one
    beside it."""
    known = library_candidate(source)
    path = None if known is None else known[1].path
    if path is None:
        return ()
    errors = {v.name: inf if v.error is None else v.error for v in variants}
    titles = {value: f"{path.name} {value:g}" for value in path.values}
    values = [value for value in path.values if titles[value] in errors]
    ranked = sorted(range(len(values)), key=lambda i: errors[titles[values[i]]])
    beside = [i for i in ranked if abs(i - ranked[0]) == 1] if ranked else []
    if not beside:
        return tuple(values)
    middle = float(f"{sqrt(values[ranked[0]] * values[beside[0]]):.0e}")
    return tuple(sorted((*values, middle), reverse=True))


def compared(
    evaluator: Evaluator, sources: Mapping[str, str], *, rises: int = 2
) -> tuple[Variant, ...]:
    """Fit variants on the inner folds, from simple to free until their error rose so many times,
    and choose one."""
    errors: list[tuple[float, ...] | Reason] = []
    means, rose = list[float](), 0
    for source in sources.values():
        errors.append(evaluator.inner_errors(source))
        means.append(inf if isinstance(errors[-1], Reason) else fmean(errors[-1]))
        rose += len(means) > 1 and means[-1] >= means[-2]
        if rose == rises:
            break
    return chosen_of(list(sources)[: len(errors)], errors)


def chosen_of(
    names: Sequence[str], errors: Sequence[tuple[float, ...] | Reason]
) -> tuple[Variant, ...]:
    """Choose the variant of the least error, or what the candidate begins with: the linear model
    where it is behind the least by no more than one standard error, its parent where every change
    is behind by more than that. What inner parts leave open between a change and its parent, the
    folds decide.

    Args:
        names: of the variants, from simple to free
        errors: of each on the same parts of held-out records, or why it failed
    """
    known = {i: np.array(e) for i, e in enumerate(errors) if not isinstance(e, Reason)}
    if not known:
        return ()
    behind, deviation = behind_least(known)
    near = {i for i in known if behind[i] <= deviation[i]}
    begun = {names[i]: i for i in known if names[i] in (LINEAR, PARENT)}
    changes = sorted(known.keys() - begun.values(), key=lambda i: behind[i])
    if begun.get(LINEAR) in near or not changes:
        chosen = next(iter(begun.values()))
    else:
        chosen = changes[0] if changes[0] in near else begun.get(PARENT, changes[0])
    return tuple(
        Variant(name, failed=error.value)
        if isinstance(error, Reason)
        else Variant(name, fmean(error), "", behind[i], deviation[i], i == chosen)
        for i, (name, error) in enumerate(zip(names, errors, strict=True))
    )


def behind_least(errors: Mapping[_Key, Array]) -> tuple[dict[_Key, float], dict[_Key, float]]:
    """How far each of several errors is behind the least, and the standard errors.

    The standard error is that of the paired difference, or that of the least error if this is
    smaller: what diverges in a single part has a difference as large as its standard error.

    Args:
        errors: (n,) of each on the same parts of held-out records
    """
    best = min(errors.values(), key=lambda e: float(e.mean()))
    behind, deviation = dict[_Key, float](), dict[_Key, float]()
    for name, e in errors.items():
        behind[name] = float((e - best).mean())
        deviation[name] = 0.0
        if len(e) > 1:
            deviation[name] = min(float(v.std(ddof=1)) for v in (e - best, best)) / sqrt(len(e))
    return behind, deviation
