"""View of a ledger: its events replayed into the state of a search."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

from asia.errors import Reason, UserError
from asia.judge.scoring.outcome import Failure, FoldRecord, Score
from asia.ledger.events import (
    Ablated,
    Confirmed,
    Evaluated,
    Event,
    Exchanged,
    Extended,
    Fit,
    GuardLooked,
    Landed,
    Noted,
    Proposed,
    ReferenceScored,
    Refitted,
    Resumed,
    SessionEnded,
    SessionStarted,
    Started,
    Steered,
    Stopped,
    Unsealed,
    Unsealing,
    Usage,
    Validated,
)

DIVERGED_V = 10.0
"""V from which on a simulation counts as diverged; the mean of the outputs has about 1."""
BELOW_TRUTH = 0.98
"""V over that of the simulated truth that no model reaches by luck: with N held-out samples chance
gives 1 - 4.5 / N at three standard deviations, 0.98 with 225."""


@dataclass(frozen=True)
class Experiment:
    """One candidate and its result; `result` is None during its evaluation."""

    proposed: Proposed
    result: Evaluated | None = None
    landed: Landed | None = None
    """Its first fit, where that ended before its turn; None once it has a result."""

    @property
    def number(self) -> int:
        """1-based."""
        return self.proposed.experiment

    @property
    def source(self) -> str:
        """Artifact with the source that was scored: a variant of the proposed one where that left
        a setting open."""
        chosen = self.result.source if self.result else None
        return chosen or self.proposed.source

    @property
    def description(self) -> str:
        """The title, or the whole hypothesis where the title is only its beginning."""
        title, hypothesis = self.proposed.title, self.proposed.hypothesis
        return hypothesis if hypothesis.startswith(title.removesuffix("…")) else title

    @property
    def score(self) -> Score | None:
        """The score, when there is one."""
        outcome = self.result.outcome if self.result else None
        return outcome if isinstance(outcome, Score) else None

    @property
    def value(self) -> float | None:
        """V, when there is a score."""
        return self.score.value if self.score else None

    @property
    def fit(self) -> float | None:
        """100 (1 - V) in percent, when there is a score."""
        return 100.0 * (1.0 - self.score.value) if self.score else None

    @property
    def failure(self) -> Failure | None:
        """The failure, when there is one."""
        outcome = self.result.outcome if self.result else None
        return outcome if isinstance(outcome, Failure) else None

    @property
    def folds(self) -> tuple[FoldRecord, ...]:
        """Evidence on the fit of each fold; () without a result or a score."""
        return self.result.folds if self.result else ()

    @property
    def seed_values(self) -> tuple[float, ...]:
        """V from each seed, that of the search first; a single value where fits do not depend on
        the seed, or none was repeated; () without a score."""
        if self.score is None or self.result is None:
            return ()
        again = [r.value for r in self.result.retests if r.value is not None and not r.same]
        return (self.score.value, *again)

    @property
    def diverged(self) -> bool:
        """Return whether its simulations left every reasonable range."""
        if self.failure is not None:
            return self.failure.reason is Reason.NOT_FINITE
        return self.score is not None and self.score.value > DIVERGED_V

    @property
    def kept(self) -> bool:
        """Return whether the experiment became the incumbent."""
        return self.result is not None and self.result.status == "keep"

    @property
    def unconfirmed(self) -> bool:
        """Return whether records that nobody could read did not confirm its V: it is handed over
        nowhere."""
        return self.result is not None and self.result.status == "unconfirmed"

    @property
    def lowest(self) -> bool:
        """Return whether its own fit was the best so far, whatever was decided on its method."""
        return self.result is not None and self.result.lowest


@dataclass(frozen=True)
class SearchView:
    """State of a search, replayed from its ledger.

    Attributes:
        budget, hours: limits as last extended, which was after experiment `extended_after`.
        unsealing: true once the test was about to be opened.
        looks, looked: evaluations on the guard records, and whether one was made since the search
            stopped.
        sessions, begun: sessions that ended, and all that began.
    """

    started: Started
    budget: int
    hours: float | None
    extended_after: int = 0
    references: tuple[ReferenceScored, ...] = ()
    notes: tuple[Steered, ...] = ()
    noted: tuple[Noted, ...] = ()
    """Notes and tags for people, the oldest first."""
    exchanges: tuple[Exchanged, ...] = ()
    sessions: tuple[SessionEnded, ...] = ()
    begun: tuple[SessionStarted, ...] = ()
    experiments: tuple[Experiment, ...] = ()
    stopped: Stopped | None = None
    refitted: Refitted | None = None
    looks: tuple[GuardLooked, ...] = ()
    looked: bool = False
    unsealing: Unsealing | None = None
    unsealed: Unsealed | None = None
    fits: tuple[Fit, ...] = ()
    """Fits after the search: of its candidates, and of the best one with parts taken back."""
    confirmed: Confirmed | None = None
    """Last confirmation; None if the search continued since."""
    ablated: Ablated | None = None
    """Last ablation; None if the search continued since."""
    validated: tuple[Validated, ...] = ()
    """The last validation report on the held-out samples, and on each new record."""

    @property
    def uncounted(self) -> int:
        """Number of experiments that the budget does not count: models that diverged as one of
        their family had done before, up to a quarter of the budget."""
        diverged = [e.proposed.family for e in self.finished if e.diverged]
        return min(len(diverged) - len(set(diverged)), self.budget // 4)

    @property
    def most_experiments(self) -> int:
        """The budget, with the experiments that it does not count."""
        return self.budget + self.uncounted

    @property
    def finished(self) -> tuple[Experiment, ...]:
        """Experiments with a result."""
        return tuple(e for e in self.experiments if e.result is not None)

    @property
    def running(self) -> tuple[Experiment, ...]:
        """Experiments that were proposed and have no result yet, the oldest first."""
        return tuple(e for e in self.experiments if e.result is None)

    @property
    def pending(self) -> Experiment | None:
        """The oldest of those without a result."""
        return next(iter(self.running), None)

    @property
    def incumbent(self) -> Experiment | None:
        """Last kept experiment, which a candidate must beat significantly."""
        return next((e for e in reversed(self.experiments) if e.kept), None)

    @property
    def bests(self) -> tuple[Experiment, ...]:
        """All best experiments so far, oldest first. If one fit decides, those that were kept. With
        retests, those whose own fit had the lowest V so far.
        """
        found: list[Experiment] = []
        for e in self.finished:
            last = found[-1] if found else None
            lower = e.score is not None and (
                last is None or last.score is None or e.score.value < last.score.value
            )
            if e.lowest or (e.kept and (last is None or not last.lowest or lower)):
                found.append(e)
        return tuple(found)

    @property
    def best(self) -> Experiment | None:
        """The experiment whose models are handed over."""
        bests = self.bests
        return bests[-1] if bests else None

    @property
    def best_value(self) -> float | None:
        """V of `best`; None where no candidate has a score."""
        return self.best.value if self.best else None

    @property
    def lineage(self) -> tuple[Experiment, ...]:
        """The best candidate after its ancestors, the oldest first; () without a best candidate."""
        found = [] if self.best is None else [self.best]
        while found and (parent := found[-1].proposed.parent) and parent < found[-1].number:
            found.append(self.experiment(parent))
        return tuple(reversed(found))

    @property
    def failed_checks(self) -> tuple[str, ...]:
        """`#02: check ... failed: ...`: diagnostics that raised an exception, a line each."""
        events = [
            *((reference.name, reference) for reference in self.references),
            *((f"#{e.number:02d}", e.result) for e in self.finished),
            ("refit", self.refitted),
            ("test", self.unsealed),
        ]
        return tuple(
            f"{name}: {line}"
            for name, event in events
            if event is not None
            for line in event.failed_checks
        )

    @property
    def complete(self) -> bool:
        """Stopped, with the best candidate refitted and the guard looked at."""
        refitted = self.refitted is not None or self.best is None
        return self.stopped is not None and refitted and not self.guard_due

    @property
    def guard_due(self) -> bool:
        """Return whether the guard is to be looked at: not if the user stopped the search."""
        ended = self.stopped is not None and self.stopped.reason != "user"
        guarded = self.started.guard_digest is not None and self.best is not None
        return ended and guarded and not self.looked

    @property
    def guard_bits(self) -> int:
        """Answers of the guard records that the agent learned, each one bit at most: that a
        candidate fails there is one too."""
        if self.started.guard_digest is None:
            return 0
        return sum(
            e.result is not None and e.result.confirmation is not None for e in self.finished
        )

    @property
    def seconds(self) -> float:
        """Wall-clock time of evaluations: what ran at the same time counts once."""
        results = (e.result for e in self.finished if e.result)
        return sum(r.seconds if r.elapsed is None else r.elapsed for r in results)

    @property
    def v_name(self) -> str:
        """Label of V in figures of this search. It differs with validation early stopping and with
        held-out residuals, whose V must not be compared with leak-free ones.
        """
        marks: list[str] = []
        if self.started.early_stopping == "validation":
            marks.append("validation early stopping")
        if self.started.residuals == "held_out":
            marks.append("held-out residuals shown")
        return f"V ({', '.join(marks)})" if marks else "V"

    def reference_value(self, name: str) -> float | None:
        """V of a reference model; None where it has none."""
        known = (r.outcome for r in self.references if r.name == name)
        return next((o.value for o in known if isinstance(o, Score)), None)

    @property
    def truth(self) -> float | None:
        """V of the noise-free outputs; None where the problem is not simulated."""
        return self.reference_value("simulated truth")

    def below_truth(self, value: float) -> bool:
        """Return whether a V is below that of the simulated truth by more than chance explains."""
        return self.truth is not None and value < BELOW_TRUTH * self.truth

    @property
    def validation_scores(self) -> int:
        """Scores on held-out parts given to candidates while they trained."""
        return sum(e.result.validation_scores for e in self.finished if e.result)

    @property
    def usage(self) -> Usage | None:
        """Usage of the agent's language model so far; its cost is None where a part is not
        known."""
        parts = [e.usage for e in (*self.exchanges, *self.sessions)]
        if not parts:
            return None
        known = [u for u in parts if u is not None]
        costs = [u.cost for u in known if u.cost is not None]
        return Usage(
            sum(u.input_tokens for u in known),
            sum(u.output_tokens for u in known),
            sum(u.cached_tokens for u in known),
            sum(costs) if known and len(costs) == len(known) else None,
            sum(u.turns for u in known),
        )

    def tags(self, experiment: int = 0) -> tuple[str, ...]:
        """Return the tags of an experiment, or of the run, that were not taken away."""
        found: dict[str, None] = {}
        for one in self.noted:
            if one.experiment == experiment:
                found |= dict.fromkeys(one.tags)
                found = {name: None for name in found if name not in one.removed}
        return tuple(found)

    def experiment(self, number: int) -> Experiment:
        """Raises UserError when there is no such experiment."""
        for experiment in self.experiments:
            if experiment.number == number:
                return experiment
        raise UserError(
            f"run '{self.started.run}' has no experiment {number}; "
            f"it has 1 to {len(self.experiments)}"
        )


# Events that the view collects, and those of which it has the last one, with the field of each.
_COLLECTED: dict[type[Event], str] = {
    ReferenceScored: "references",
    Steered: "notes",
    Noted: "noted",
    Fit: "fits",
    Exchanged: "exchanges",
    SessionStarted: "begun",
    SessionEnded: "sessions",
}
_LAST: dict[type[Event], str] = {
    Stopped: "stopped",
    Refitted: "refitted",
    Confirmed: "confirmed",
    Ablated: "ablated",
    Unsealing: "unsealing",
    Unsealed: "unsealed",
}


class Replay:
    """Folds events into a view, one at a time. Raises UserError for events that cannot follow one
    another: no start or a second one, an experiment or a result that is there already."""

    def __init__(self) -> None:
        self._view: SearchView | None = None
        self._experiments: dict[int, Experiment] = {}
        self._repeats = set[tuple[int, int]]()
        self._collected: dict[str, list[Event]] = {name: [] for name in _COLLECTED.values()}

    @property
    def view(self) -> SearchView:
        """The view after the last event. Raises UserError where there was none yet."""
        if self._view is None:
            raise UserError("the ledger is empty: the search was stopped before it began")
        collected: dict[str, Any] = {name: tuple(ones) for name, ones in self._collected.items()}
        return replace(
            self._view,
            **collected,
            experiments=tuple(self._experiments.values()),
        )

    def add(self, event: Event) -> None:
        """The next event."""
        if self._view is None:
            if not isinstance(event, Started):
                raise UserError("the ledger does not begin with the start of a search")
            self._view = SearchView(event, event.experiments, event.hours)
            return
        view = self._view
        match event:
            case Started():
                raise UserError("the ledger starts twice")
            case Proposed(experiment=number):
                if number in self._experiments:
                    raise UserError(f"the ledger has experiment {number} twice")
                self._experiments[number] = Experiment(event)
            case Landed(experiment=number):
                known = self._experiments.get(number)
                if known is None or known.result is not None or known.landed is not None:
                    raise UserError(
                        f"the ledger has two first fits of experiment {number}, or one before "
                        "its proposal or after its result"
                    )
                self._experiments[number] = replace(known, landed=event)
            case Evaluated(experiment=number):
                known = self._experiments.get(number)
                if known is None or known.result is not None:
                    raise UserError(
                        f"the ledger has two results of experiment {number}, or a result "
                        "before its proposal"
                    )
                self._experiments[number] = Experiment(known.proposed, event)
            case Extended():
                self._view = replace(
                    _continued(view),
                    budget=event.experiments,
                    hours=event.hours,
                    extended_after=len(self._experiments),
                )
            case Resumed():
                self._view = _continued(view)
            case GuardLooked():
                self._view = replace(view, looks=(*view.looks, event), looked=True)
            case Validated():
                # The one on what the folds held out comes first.
                record = event.record_digest
                others = [one for one in view.validated if one.record_digest != record]
                validated = [*others, event] if event.record else [event, *others]
                self._view = replace(view, validated=tuple(validated))
            case _ if type(event) in _COLLECTED:
                if isinstance(event, Fit) and event.purpose == "confirmation":
                    number, repeat = event.experiment, event.seed
                    if (number, repeat) in self._repeats:
                        raise UserError(
                            f"the ledger has repeat {repeat} of experiment {number} twice"
                        )
                    self._repeats.add((number, repeat))
                self._collected[_COLLECTED[type(event)]].append(event)
            case _ if type(event) in _LAST:
                last: dict[str, Any] = {_LAST[type(event)]: event}
                self._view = replace(view, **last)
            case _:
                pass


def replay(events: Iterable[Event]) -> SearchView:
    """Fold events into a view. Raises UserError when there is none, or as `Replay`."""
    replayed = Replay()
    for event in events:
        replayed.add(event)
    return replayed.view


def _continued(view: SearchView) -> SearchView:
    """Return the view without the results of a finished search."""
    return replace(
        view, stopped=None, refitted=None, looked=False, confirmed=None, ablated=None, validated=()
    )
