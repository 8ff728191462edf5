"""View of a search for its agent, derived from the ledger."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from functools import lru_cache
from statistics import median_high

import numpy as np

from asia._diagnostic import diagnostic
from asia.agents.view import AgentView, Effort, Facts, Running, Trial
from asia.candidate import source_digest
from asia.data.standardise import standardised
from asia.data.trajectory import Trajectory
from asia.errors import CandidateError
from asia.judge.evaluation.error_analysis import MissingTerm, terms_beyond_linear
from asia.judge.evaluation.fold_fits import known_system, search_context
from asia.judge.evaluation.references import LINEAR_REFERENCE, MEAN_REFERENCE
from asia.ledger.artifacts import Store
from asia.ledger.evidence import RunSettings, evidence_of, folds_of
from asia.ledger.view import Experiment, SearchView
from asia.presentation.evidence import evidence_lines
from asia.problem.problem import Problem
from asia.recipe import read_recipe
from asia.search.rules import phase

CURVE_POINTS = 200


def problem_facts(problem: Problem) -> Facts:
    """The problem as agents may know it, its signals standardised as fits do."""
    rule = problem.protocol
    return Facts(
        **known_system(problem).known(),
        description=problem.description,
        records=_standardised(problem),
        early_stopping=rule.early_stopping,
        folds=rule.folds.count,
        groups=tuple(group.records for group in rule.folds.groups),
        budget=Effort(problem.budget.experiments, problem.budget.fit_seconds),
        notes=problem.notes,
        strategies=problem.strategies,
        terms=lambda: _terms_beyond_linear(problem),
        identification=problem.control and problem_facts(problem.control.base),
    )


@lru_cache(maxsize=2)
def _standardised(problem: Problem) -> tuple[Trajectory, ...]:
    """Return the same objects for the same problem: analyses of records are kept by them."""
    return tuple(standardised(list(problem.train), search_context(problem, 0))[0])


@lru_cache(maxsize=2)
def _terms_beyond_linear(problem: Problem) -> tuple[tuple[str, str, float], ...]:
    found: tuple[MissingTerm, ...] = ()
    with diagnostic("score test of a linear model", []):
        context = search_context(problem, 0)
        found = terms_beyond_linear(_standardised(problem), context, problem.protocol)
    return tuple((t.term, t.where, t.share) for t in found)


class KnownTrials:
    """The trials of a search that goes on, so that their artifacts are read once."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._found: dict[int, tuple[Experiment, Trial]] = {}

    def trial(self, e: Experiment) -> Trial:
        """Return the visible part of an experiment that has its result."""
        known = self._found.get(e.number)
        if known is None or known[0].proposed is not e.proposed or known[0].result is not e.result:
            known = self._found[e.number] = e, _trial(e, self._store)
        return known[1]


def agent_view(
    facts: Facts, view: SearchView, store: Store, known: KnownTrials | None = None
) -> AgentView:
    """The search as its agent may see it now. known: of earlier views of this search."""
    known = known or KnownTrials(store)
    shown = {e.number for e in (view.best, *view.finished[-1:]) if e is not None}
    settings = RunSettings(facts.inputs, facts.outputs, facts.budget.fit_seconds, 0)
    tried = {e.proposed.digest for e in view.experiments}
    linear = next((r for r in view.references if r.name == LINEAR_REFERENCE), None)
    recipe = read_recipe(linear.source) if linear is not None else None
    if recipe is not None:
        facts = replace(facts, linear=recipe.config)
    elif linear is not None and linear.structure is not None:
        order, delay = linear.structure
        known_linear = ("order", order), ("delay", delay), ("periodic", True)
        facts = replace(facts, linear=known_linear)
    trials: list[Trial] = []
    for e in view.finished:
        trial = known.trial(e)
        if e.number in shown:
            found = evidence_of(e, view, store, settings)
            # Without measured seconds and memory. Prompts of older ledgers must not change.
            lines = evidence_lines(found, e.seed_values, measured=False) if found.recorded else ()
            shares = dict[str, float]()
            for one in (c for fold in found.folds for c in fold.checks or ()):
                shares[one.name] = max(one.weight, shares.get(one.name, 0.0))
            ranked = sorted(shares.items(), key=lambda item: -item[1])
            diagnoses = tuple(ranked) if found.recorded else ()
            trial = replace(trial, evidence=tuple(lines), diagnoses=diagnoses)
        trials.append(trial)
    return AgentView(
        facts=facts,
        seed=view.started.seed,
        phase=phase(view),
        trials=tuple(trials),
        remaining=view.most_experiments - len(view.experiments),
        is_known=lambda source: digest(source) in tried,
        notes=tuple(note.text for note in view.notes),
        linear=view.reference_value(LINEAR_REFERENCE),
        mean=view.reference_value(MEAN_REFERENCE),
        running=tuple(
            Running(
                p.experiment,
                p.parent,
                p.family,
                p.title,
                p.hypothesis,
                p.expected,
                store.text(p.source),
            )
            for p in (e.proposed for e in view.running)
        ),
    )


def digest(source: str) -> str:
    """Digest of the normalised source; of the text itself when it does not parse."""
    try:
        return source_digest(source)
    except CandidateError:
        return hashlib.sha256(as_bytes(source)).hexdigest()


def as_bytes(source: str) -> bytes:
    """UTF-8; what cannot be encoded is kept as an escape."""
    return source.encode("utf-8", "backslashreplace")


def _trial(e: Experiment, store: Store) -> Trial:
    p, r = e.proposed, e.result
    assert r is not None
    score, failure = e.score, e.failure
    curves: list[tuple[tuple[float, float], ...]] = []
    for fold in r.folds:
        table = np.frombuffer(store.get(fold.curve), "<f8").reshape(-1, 2)
        thinned = table[:: max(1, -(-len(table) // CURVE_POINTS))]
        curves.append(tuple((float(step), float(loss)) for step, loss in thinned))
    return Trial(
        number=p.experiment,
        parent=p.parent,
        phase=p.phase,
        family=p.family,
        title=p.title,
        hypothesis=p.hypothesis,
        expected=p.expected,
        source=store.text(p.source),
        status=r.status,
        value=score.value if score else None,
        folds=tuple(f.value for f in score.folds) if score else (),
        failure=f"{failure.reason.value}: {failure.advice}" if failure else None,
        diagnostics=tuple(f.diagnostics for f in r.folds),
        curves=tuple(curves),
        error=failure.detail if failure else "",
        lowest=r.lowest,
        order=_order(e, store),
        variant=next((one.name for one in r.variants if one.chosen), ""),
    )


def _order(e: Experiment, store: Store) -> int | None:
    tables = (dict(found.parameters) for found in folds_of(store, e))
    known = [table["order [states]"] for table in tables if "order [states]" in table]
    return round(median_high(known)) if known else None
