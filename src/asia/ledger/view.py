"""View of a ledger: its events replayed into the state of a search."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from dataclasses import astuple, dataclass, replace
from typing import Any

from asia._text import coarse, rounded
from asia.errors import KNOWN_ERRORS, Reason, UserError
from asia.judge.scoring.outcome import Failure, Score
from asia.judge.scoring.residuals import Diagnostics
from asia.ledger.events import (
    Ablated,
    AblationFit,
    Confirmed,
    Evaluated,
    Event,
    Exchanged,
    Extended,
    FoldEvidence,
    GuardLooked,
    HandedOver,
    Landed,
    Noted,
    Proposed,
    ReferenceScored,
    Refitted,
    Repeated,
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
    def folds(self) -> tuple[FoldEvidence, ...]:
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
        handed_over: changes of the agent in a relay.
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
    handed_over: tuple[HandedOver, ...] = ()
    repeats: tuple[Repeated, ...] = ()
    """Fits of candidates after the search, from other seeds."""
    confirmed: Confirmed | None = None
    """Last confirmation; None if the search continued since."""
    ablation_fits: tuple[AblationFit, ...] = ()
    """Fits of the best candidate with parts taken back, after the search."""
    ablated: Ablated | None = None
    """Last ablation; None if the search continued since."""
    validated: tuple[Validated, ...] = ()
    """The last validation report on the held-out samples, and on each new record."""

    @property
    def leg(self) -> int:
        """The leg of the relay whose agent proposes, 1-based; 0 where one agent does."""
        if self.handed_over:
            return self.handed_over[-1].leg
        return 1 if self.started.legs else 0

    @property
    def uncounted(self) -> int:
        """Number of experiments that the budget does not count: models that diverged as one of
        their family had done before, up to a quarter of the budget."""
        diverged = [e.proposed.family for e in self.finished if e.diverged]
        return min(len(diverged) - len(set(diverged)), self.budget // 4)

    @property
    def leg_end(self) -> int:
        """The experiment after which the agent that proposes now does so no longer."""
        legs = self.started.legs[: self.leg]
        counts = [leg.experiments for leg in legs if leg.experiments is not None]
        planned = sum(counts) if counts and len(counts) == len(legs) else self.budget
        return min(self.budget, planned) + self.uncounted

    @property
    def agent(self) -> str:
        """The agent that proposes now."""
        return self.started.legs[self.leg - 1].agent if self.leg else self.started.agent

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
    AblationFit: "ablation_fits",
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
        self._repeats: dict[tuple[int, int], Repeated] = {}
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
            repeats=tuple(self._repeats.values()),
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
            case Repeated(experiment=number, repeat=repeat):
                if (number, repeat) in self._repeats:
                    raise UserError(f"the ledger has repeat {repeat} of experiment {number} twice")
                self._repeats[number, repeat] = event
            case HandedOver():
                self._view = replace(view, handed_over=(*view.handed_over, event))
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


# Scores that agents may see.
#
# The Ladder (Blum and Hardt, ICML 2015): a score is reported only if it is lower than the last
# reported one by a step, and then rounded to a grid of steps. So the information in the reported
# scores of any number of candidates is bounded by the number of steps. V has no upper limit, so
# the step is relative and the grid geometric. As in their parameter-free form, the gain must
# exceed its own scatter. Here this is the scatter over parts of the held-out records, because the
# errors of single samples are correlated in time.


def on_ladder(value: float, step: float) -> float:
    """The nearest power of 1 - `step`."""
    return (1.0 - step) ** round(math.log(value) / math.log1p(-step)) if value > 0 else 0.0


def published(view: SearchView) -> SearchView:
    """The view with the reported scores; unchanged without the Ladder. With it, an experiment that
    was kept has its V on the grid. Any other with a score has the last reported V. None has scores
    of its folds. A failure that depends on held-out outputs is reported, once a V was, as a score
    that was not kept. Words of a candidate are left out, and figures that it can influence are
    rounded."""
    step = view.started.ladder
    if step is None:
        return view
    reported: float | None = None
    experiments = list(view.experiments)
    for i, experiment in enumerate(experiments):
        result, score, failure = experiment.result, experiment.score, experiment.failure
        hidden = failure is not None and failure.reason is Reason.RESTART
        if result is not None:
            result = _bounded(result)
            experiments[i] = replace(experiment, result=result)
        if result is None or not (score or (hidden and reported is not None)):
            continue
        if score and (reported is None or result.status == "keep"):
            reported = on_ladder(score.value, step)
        assert reported is not None
        # That a score beat the best is reported with a new best alone.
        status = "discard" if hidden or result.status == "unconfirmed" else result.status
        result = replace(result, status=status, outcome=Score(reported, ()))
        experiments[i] = replace(experiment, result=result)
    return replace(view, experiments=tuple(experiments))


_OWN_WORDS = frozenset({Reason.SYNTAX, Reason.CONTRACT, Reason.CRASH, Reason.EXITED, Reason.MEMORY})
_OWN_NUMBERS = frozenset({Reason.WRONG_LENGTH, Reason.UNSOLICITED, Reason.MODEL_SIZE})
_LINE = re.compile(r'File "[^"]*candidate(?:\.py)?", line (\d{1,5})\b')
_ERROR = re.compile(r"^(\w+)(?::|$)")
_DIGITS = 2


def _bounded(result: Evaluated) -> Evaluated:
    """The result without what a candidate can say by words and long numbers: it has seen training
    records, which other folds hold out."""
    outcome = result.outcome
    if isinstance(outcome, Failure):
        outcome = replace(outcome, detail=_bounded_detail(outcome))
    folds = tuple(
        replace(
            fold,
            diagnostics=Diagnostics(*(rounded(v, _DIGITS) for v in astuple(fold.diagnostics))),
            fit_seconds=coarse(fold.fit_seconds),
        )
        for fold in result.folds
    )
    return replace(result, outcome=outcome, folds=folds, seconds=coarse(result.seconds))


def _bounded_detail(failure: Failure) -> str:
    """Type of an exception, where Python or a library defines it, and the line of candidate.py."""
    if failure.reason in _OWN_NUMBERS:
        return ""
    if failure.reason not in _OWN_WORDS:
        return failure.detail
    lines = failure.detail.strip().splitlines()
    error = _ERROR.match(lines[-1]) if lines else None
    name = error[1] if error is not None and error[1] in KNOWN_ERRORS else ""
    places = _LINE.findall(failure.detail)
    if not places:
        return name
    return f'File "candidate.py", line {places[-1]}\n{name or "an exception of its own"}'
