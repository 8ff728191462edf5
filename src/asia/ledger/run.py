"""A run directory opened for reading."""

import tomllib
import traceback
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from asia._diagnostic import error_sentence
from asia._text import one_line
from asia.errors import UserError
from asia.judge.scoring.outcome import Failure
from asia.ledger.artifacts import Store
from asia.ledger.chain import Line, in_use, ledger_of, read_lines, write_whole
from asia.ledger.events import TestedModel, Unsealed, Use
from asia.ledger.view import Experiment, SearchView, replay

ERROR = "error.txt"
"""Name of the file next to the ledger with the error that stopped the search last."""

RunState = Literal["running", "interrupted", "finished", "unsealed"]


def state_of(view: SearchView, *, busy: bool) -> RunState:
    """The state of a search. busy: true if a process holds the ledger."""
    if view.unsealed:
        return "unsealed"
    if busy:
        return "running"
    return "finished" if view.complete else "interrupted"


@dataclass(frozen=True)
class Run:
    """A run directory opened for reading."""

    directory: Path
    view: SearchView
    lines: tuple[Line, ...]
    busy: bool

    def __repr__(self) -> str:
        best = self.view.best
        value = f", best #{best.number} V={best.score.value:.6g}" if best and best.score else ""
        count = len(self.view.experiments)
        return f"Run('{self.directory}', {self.state}, {count} experiments{value})"

    @property
    def name(self) -> str:
        """Name of the run."""
        return self.directory.name

    @property
    def store(self) -> Store:
        """Its artifacts."""
        return Store(self.directory / "artifacts")

    @property
    def metric(self) -> str:
        """The name of the metric. Raises UserError as `metric_of`."""
        return metric_of(self.directory)

    @property
    def state(self) -> RunState:
        """State of the search."""
        return state_of(self.view, busy=self.busy)


def open_run(directory: Path) -> Run:
    """Read and verify a run. Raises UserError when it is not one or does not verify."""
    ledger = ledger_of(directory)
    lines = tuple(read_lines(ledger))
    return Run(directory, replay(line.event for line in lines), lines, in_use(ledger))


def keep_error(directory: Path, error: Exception) -> Path:
    """Write the error that stopped a search, with its traceback, next to the ledger; the file."""
    path = directory / ERROR
    lines = "".join(traceback.format_exception(error))
    write_whole(path, f"{error_sentence(error)}\n\n{lines}".encode("utf-8", "replace"))
    return path


def error_of(directory: Path) -> str | None:
    """The sentence of the error that ended the search last; None where none did."""
    try:
        return one_line((directory / ERROR).read_text("utf-8").partition("\n")[0]) or None
    except (OSError, ValueError):
        return None


def metric_of(directory: Path) -> str:
    """The name of a run's metric, from its lock file. Raises UserError when that cannot be read."""
    path = directory / "problem.lock.toml"
    try:
        return tomllib.loads(path.read_text("utf-8"))["protocol"]["metric"]
    except (OSError, ValueError, KeyError) as error:
        raise UserError(
            f"{path} cannot be read ({error}): the metric of the run is not known"
        ) from None


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


@dataclass(frozen=True)
class ModelToUse:
    """The model to use and why."""

    model: Use
    reason: str
    """A sentence."""


def scored_experiment(run: Run, number: int) -> Experiment:
    """Return an experiment whose model may be handed over. Raises UserError for one without a
    score, and one that the guard records did not confirm."""
    found = next((e for e in run.view.finished if e.number == number), None)
    if found is None or found.score is None:
        raise UserError(f"run '{run.name}' has no scored experiment {number}")
    if found.unconfirmed:
        raise UserError(
            f"experiment {number} of run '{run.name}' is unconfirmed: records that nobody in the "
            "search could read do not show its gain, so its model is not handed over. Choose "
            "another experiment"
        )
    return found


def model_to_use(view: SearchView) -> ModelToUse | None:
    """The model that the search names. The ensemble while it goes on, and in a ledger of an older
    version, which names none. None where no candidate has a score."""
    if view.best is None:
        return None
    refitted = view.refitted
    if refitted is None:
        return ModelToUse("ensemble", "The search is not finished: there is no other model yet.")
    if refitted.use is None:
        reason = "The search is of an older version, which did not check the refit."
        return ModelToUse("ensemble", reason)
    return ModelToUse(refitted.use, refitted.reason)


def final_models(record: Unsealed) -> dict[Use, TestedModel | Failure]:
    """The result of the sealed test for each final model."""
    models: dict[Use, TestedModel | Failure | None] = {
        "ensemble": record.ensemble, "refit": record.refit, "stack": record.stack
    }  # fmt: skip
    return {use: model for use, model in models.items() if model is not None}


def tested_model(record: Unsealed, use: Use) -> TestedModel | Failure:
    """The result of the sealed test for this model; that of the ensemble if it has none."""
    return final_models(record).get(use, record.ensemble)
