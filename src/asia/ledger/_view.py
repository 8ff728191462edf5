"""The ledger replayed into what a person asks about."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from asia.errors import UserError
from asia.ledger._chain import Line, in_use, read_lines
from asia.ledger._events import (
    Evaluated,
    Event,
    Exchanged,
    Extended,
    Proposed,
    Refitted,
    Resumed,
    RungScored,
    SessionEnded,
    SessionStarted,
    Started,
    Steered,
    Stopped,
    Streamed,
    Unsealed,
    Unsealing,
    Usage,
)
from asia.ledger._store import Store
from asia.scoring import Failure, Score

State = Literal["running", "interrupted", "finished", "unsealed"]


@dataclass(frozen=True)
class Experiment:
    """One candidate and what came of it; `result` is None while it is being evaluated."""

    proposed: Proposed
    result: Evaluated | None = None

    @property
    def number(self) -> int:
        """1-based."""
        return self.proposed.experiment

    @property
    def score(self) -> Score | None:
        """The score, when there is one."""
        outcome = self.result.outcome if self.result else None
        return outcome if isinstance(outcome, Score) else None

    @property
    def failure(self) -> Failure | None:
        """The failure, when there is one."""
        outcome = self.result.outcome if self.result else None
        return outcome if isinstance(outcome, Failure) else None


@dataclass(frozen=True)
class SearchView:
    """A search as its ledger tells it. `budget` experiments and `hours` as last extended, which
    was after experiment `extended_after`; `unsealing` once the test was about to be opened; `notes`
    of the person; `exchanges` of the agent, its `sessions` that ended and all that were `begun`."""

    started: Started
    budget: int
    hours: float | None
    extended_after: int = 0
    rungs: tuple[RungScored, ...] = ()
    notes: tuple[Steered, ...] = ()
    exchanges: tuple[Exchanged, ...] = ()
    sessions: tuple[SessionEnded, ...] = ()
    begun: tuple[SessionStarted, ...] = ()
    experiments: tuple[Experiment, ...] = ()
    stopped: Stopped | None = None
    refitted: Refitted | None = None
    unsealing: Unsealing | None = None
    unsealed: Unsealed | None = None

    @property
    def finished(self) -> tuple[Experiment, ...]:
        """Experiments with a result."""
        return tuple(e for e in self.experiments if e.result is not None)

    @property
    def pending(self) -> Experiment | None:
        """The experiment that was proposed and not yet evaluated."""
        return next((e for e in self.experiments if e.result is None), None)

    @property
    def best(self) -> Experiment | None:
        """The incumbent: the last one kept."""
        kept = [e for e in self.finished if e.result and e.result.status == "keep"]
        return kept[-1] if kept else None

    @property
    def complete(self) -> bool:
        """Stopped, with the winner refitted."""
        return self.stopped is not None and (self.refitted is not None or self.best is None)

    @property
    def seconds(self) -> float:
        """Time spent on evaluations."""
        return sum(e.result.seconds for e in self.finished if e.result)

    @property
    def v_name(self) -> str:
        """What V is called beside a figure of this search: with validation early stopping it is
        not leak-free, and stands in no table with one that is."""
        inner = self.started.early_stopping == "inner"
        return "V" if inner else "V (validation early stopping)"

    @property
    def validation_scores(self) -> int:
        """Scores on held-out parts given to candidates while they trained."""
        return sum(e.result.validation_scores for e in self.finished if e.result)

    @property
    def usage(self) -> Usage | None:
        """What the agent's language model consumed so far; None for agents without one. The cost is
        None as soon as one part of it is not known."""
        parts = [e.usage for e in (*self.exchanges, *self.sessions)]
        if not parts:
            return None
        known = [u for u in parts if u is not None]
        costs = [u.cost for u in known]
        return Usage(
            sum(u.input_tokens for u in known),
            sum(u.output_tokens for u in known),
            sum(u.cached_tokens for u in known),
            None if None in costs or not costs else sum(c for c in costs if c is not None),
            sum(u.turns for u in known),
        )

    def experiment(self, number: int) -> Experiment:
        """Raises UserError when there is no such experiment."""
        for experiment in self.experiments:
            if experiment.number == number:
                return experiment
        raise UserError(
            f"run '{self.started.run}' has no experiment {number}; "
            f"it has 1 to {len(self.experiments)}"
        )


def replay(events: Iterable[Event]) -> SearchView:
    """Fold events into a view. Raises UserError when the first is not `started`."""
    stream = iter(events)
    first = next(stream, None)
    if not isinstance(first, Started):
        raise UserError("the ledger is empty: the search was stopped before it began")
    view = SearchView(first, first.experiments, first.hours)
    for event in stream:
        view = _apply(view, event)
    return view


def _apply(view: SearchView, event: Event) -> SearchView:
    match event:
        case RungScored():
            return replace(view, rungs=(*view.rungs, event))
        case Proposed():
            return replace(view, experiments=(*view.experiments, Experiment(event)))
        case Evaluated():
            done = tuple(
                replace(e, result=event) if e.number == event.experiment else e
                for e in view.experiments
            )
            return replace(view, experiments=done)
        case Extended():
            return replace(
                view,
                budget=event.experiments,
                hours=event.hours,
                extended_after=len(view.experiments),
                stopped=None,
                refitted=None,
            )
        case Stopped():
            return replace(view, stopped=event)
        case Resumed():
            return replace(view, stopped=None, refitted=None)
        case Steered():
            return replace(view, notes=(*view.notes, event))
        case Exchanged():
            return replace(view, exchanges=(*view.exchanges, event))
        case SessionStarted():
            return replace(view, begun=(*view.begun, event))
        case SessionEnded():
            return replace(view, sessions=(*view.sessions, event))
        case Streamed():
            return view
        case Refitted():
            return replace(view, refitted=event)
        case Unsealing():
            return replace(view, unsealing=event)
        case Unsealed():
            return replace(view, unsealed=event)
        case Started():
            raise UserError("the ledger starts twice")


@dataclass(frozen=True)
class Run:
    """A run directory opened for reading."""

    directory: Path
    view: SearchView
    lines: tuple[Line, ...]
    busy: bool

    @property
    def name(self) -> str:
        """Name of the run."""
        return self.directory.name

    @property
    def store(self) -> Store:
        """Its artifacts."""
        return Store(self.directory / "artifacts")

    @property
    def state(self) -> State:
        """Where the search stands."""
        if self.view.unsealed:
            return "unsealed"
        if self.busy:
            return "running"
        return "finished" if self.view.complete else "interrupted"


def open_run(directory: Path) -> Run:
    """Read and verify a run. Raises UserError when it is not one or does not verify."""
    ledger = directory / "ledger.jsonl"
    if not ledger.is_file():
        raise UserError(f"{directory} is not a run: it has no ledger.jsonl")
    lines = tuple(read_lines(ledger))
    return Run(directory, replay(line.event for line in lines), lines, in_use(ledger))


def find_run(runs: Path, name: str | None) -> Path:
    """RUN is a path, a name below `runs`, or None for the newest. Raises UserError."""
    if name is not None:
        for path in (Path(name), runs / name):
            if (path / "ledger.jsonl").is_file():
                return path
        known = ", ".join(sorted(p.parent.name for p in runs.glob("*/ledger.jsonl"))) or "none"
        raise UserError(f"no run '{name}' under {runs}; there is: {known}")
    found = list(runs.glob("*/ledger.jsonl"))
    if not found:
        raise UserError(f"no runs under {runs}; start one with: asia run PROBLEM")
    return max(found, key=lambda p: p.stat().st_mtime).parent
