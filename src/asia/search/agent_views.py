"""View of a search for its agent, derived from the ledger."""

from __future__ import annotations

import hashlib
from dataclasses import replace

import numpy as np

from asia.agents.view import AgentView, Effort, Facts, Running, Trial
from asia.candidate import source_digest
from asia.errors import CandidateError
from asia.judge.evaluation.references import LINEAR_REFERENCE, MEAN_REFERENCE
from asia.judge.scoring.outcome import Score
from asia.ledger.artifacts import Store
from asia.ledger.events import Proposed
from asia.ledger.evidence import RunSettings, evidence_of
from asia.ledger.text import evidence_lines
from asia.ledger.view import Experiment, SearchView, published
from asia.problem.problem import Problem
from asia.search.rules import phase

CURVE_POINTS = 200


def problem_facts(problem: Problem) -> Facts:
    """The problem as agents may know it."""
    rule = problem.protocol
    return Facts(
        description=problem.description,
        inputs=problem.inputs,
        outputs=problem.outputs,
        sampling_time=problem.sampling_time,
        records=problem.train,
        past_inputs=rule.past_inputs,
        past_outputs=rule.past_outputs,
        physics=problem.physics,
        horizon=rule.horizon,
        metric=rule.metric,
        early_stopping=rule.early_stopping,
        ladder=rule.ladder,
        folds=rule.folds.count,
        groups=tuple(group.records for group in rule.folds.groups),
        budget=Effort(problem.budget.experiments, problem.budget.fit_seconds),
        notes=problem.notes,
        strategies=problem.strategies,
        symmetry=problem.symmetry,
    )


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
    view = published(view)
    shown = {e.number for e in (view.best, *view.finished[-1:]) if e is not None}
    settings = RunSettings(facts.inputs, facts.outputs, facts.budget.fit_seconds, 0)
    tried = {e.proposed.digest for e in view.experiments}
    return AgentView(
        facts=facts,
        seed=view.started.seed,
        phase=phase(view),
        trials=tuple(
            replace(known.trial(e), evidence=_evidence(e, view, store, settings))
            if e.number in shown
            else known.trial(e)
            for e in view.finished
        ),
        remaining=view.leg_end - len(view.experiments),
        is_known=lambda source: digest(source) in tried,
        notes=tuple(note.text for note in view.notes),
        linear=_reference(view, LINEAR_REFERENCE),
        leg=view.leg,
        mean=_reference(view, MEAN_REFERENCE),
        running=tuple(_running(e.proposed, store) for e in view.running),
    )


def _running(p: Proposed, store: Store) -> Running:
    return Running(
        p.experiment,
        p.parent,
        p.family,
        p.title,
        p.hypothesis,
        p.expected,
        store.text(p.source),
        p.agent,
    )


def _reference(view: SearchView, name: str) -> float | None:
    """Return V of a reference model; None with the Ladder, which reports V of some candidates
    only.
    """
    if view.started.ladder is not None:
        return None
    outcomes = (reference.outcome for reference in view.rungs if reference.name == name)
    return next((found.value for found in outcomes if isinstance(found, Score)), None)


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
        curves=tuple(_points(store.get(f.curve)) for f in r.folds),
        error=failure.detail if failure else "",
        agent=p.agent,
        lowest=r.lowest,
    )


def _evidence(
    e: Experiment, view: SearchView, store: Store, settings: RunSettings
) -> tuple[str, ...]:
    """Return the evidence without measured seconds and memory; () in older ledgers, whose prompts
    must not change.
    """
    bounded = view.started.ladder is not None
    found = evidence_of(e, view, store, settings, bounded=bounded)
    return tuple(evidence_lines(found, measured=False)) if found.recorded else ()


def _points(raw: bytes) -> tuple[tuple[float, float], ...]:
    table = np.frombuffer(raw, "<f8").reshape(-1, 2)
    thinned = table[:: max(1, -(-len(table) // CURVE_POINTS))]
    return tuple((float(step), float(loss)) for step, loss in thinned)
