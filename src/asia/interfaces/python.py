"""Python interface: an estimator from arrays to a model, and a run as a table."""

from __future__ import annotations

import hashlib
import inspect
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from asia._api import run as search_for_model
from asia._text import say
from asia.agents.view import Agent
from asia.analysis.verdict import Usability, usability
from asia.data.arrays import name_signals, one_a_record, read_arrays
from asia.data.trajectory import Array, Signal, real_numbers
from asia.errors import UserError
from asia.export.linear import linearize
from asia.export.pipeline import Exported
from asia.export.pipeline import export as export_model
from asia.judge.scoring.outcome import fit_index
from asia.ledger.events import Evaluated, Event, Use
from asia.ledger.evidence import IdentifiedParameter, identified
from asia.ledger.run import Run, find_run, model_to_use, open_run
from asia.ledger.view import SearchView
from asia.presentation.experiments import experiment_line
from asia.problem.folds import past_outputs
from asia.problem.load import load_lock
from asia.problem.plant import plant_file
from asia.problem.problem import Problem
from asia.report.brief import brief_html
from asia.report.files import write_report
from asia.report.page.page import write_page
from asia.search.run import LOCK
from asia.search.simulation import BandedSimulation, simulate, simulate_cases

if TYPE_CHECKING:
    import pandas as pd


# A run as a table.


def load_run(run: Run | Path | str | None = None, *, runs: Path | str = "runs") -> pd.DataFrame:
    """The experiments of a run, one row each, by their number.

    run: a run such as `SystemIdentifier.run_`, a path, a name below `runs`, or None for the newest
    one. Columns: `V`, the value of each
    fold (`V_fold1`, ...), `status`, `family`, `title`, `parent`, `hypothesis`, `seconds` and
    `failure`; what there is none of is missing. `frame.attrs` has `run`, `problem`, `metric`, and
    `best`, the number of the best experiment. Needs pandas. Raises UserError when there is no such
    run, or no pandas.
    """
    try:
        import pandas as pd
    except ImportError:
        raise UserError("a data frame needs pandas: pip install pandas") from None
    if isinstance(run, Run):
        run = run.directory
    opened = open_run(find_run(Path(runs), None if run is None else str(run)))
    view = opened.view
    rows: list[dict[str, Any]] = []
    for experiment in view.experiments:
        proposed, score = experiment.proposed, experiment.score
        result, failure = experiment.result, experiment.failure
        folds = score.folds if score else ()
        rows.append(
            {
                "V": score.value if score else float("nan"),
                **{f"V_fold{k}": fold.value for k, fold in enumerate(folds, 1)},
                "status": result.status if result else "running",
                "family": proposed.family,
                "title": proposed.title,
                "parent": proposed.parent,
                "hypothesis": proposed.hypothesis,
                "seconds": result.seconds if result else float("nan"),
                "failure": failure.reason.advice if failure else None,
            }
        )
    numbers = pd.Index([e.number for e in view.experiments], name="experiment")
    frame = pd.DataFrame(rows, index=numbers)
    frame.attrs.update(
        run=opened.name,
        problem=view.started.problem,
        metric=opened.metric,
        best=view.best.number if view.best else None,
    )
    return frame


# An estimator over a whole search.


Table = Mapping[str, Any]


class SystemIdentifier:
    """Searches for a model of records in memory, and simulates with the one that it finds.

    Parameters are those of `asia run` and of problem.toml: `experiments`, `agent`, `seed`;
    `protocol`, `budget`, `physics`, `symmetry`, `plant`: tables with the keys of problem.toml;
    `source` of `plant` may be a function of a Python file. `description` of the system in plain
    English. `model`: `ensemble`, `refit` or `stack` instead of the one that
    the search names. `runs`: the directory of runs. `directory`: where the problem is written, by
    default below `runs` under a name made from records and settings, so that the same call resumes.
    `progress`: print a line for each experiment.

    After `fit`: `run_`, the run; `problem_`; `value_`, V of the best candidate; `source_`, its
    code.
    """

    def __init__(
        self,
        experiments: int = 15,
        *,
        agent: Agent | str = "expert",
        seed: int = 0,
        protocol: Table | None = None,
        budget: Table | None = None,
        physics: Table | None = None,
        symmetry: Any = None,
        plant: Table | None = None,
        description: str = "",
        model: Use | None = None,
        runs: Path | str = "runs",
        directory: Path | str | None = None,
        progress: bool = True,
    ) -> None:
        self.experiments = experiments
        self.agent = agent
        self.seed = seed
        self.protocol = protocol
        self.budget = budget
        self.physics = physics
        self.symmetry = symmetry
        self.plant = plant
        self.description = description
        self.model: Use | None = model
        self.runs = runs
        self.directory = directory
        self.progress = progress

    def get_params(self, deep: bool = True) -> dict[str, Any]:
        """The parameters by name. deep: has no effect, none has parameters of its own."""
        del deep
        return {name: getattr(self, name) for name in _parameters()}

    def set_params(self, **parameters: Any) -> Self:
        """Change parameters. Raises UserError for a name that there is not."""
        for name, value in parameters.items():
            if name not in _parameters():
                raise UserError(f"no parameter '{name}'; there are {', '.join(_parameters())}")
            setattr(self, name, value)
        return self

    def fit(
        self,
        u: Any,
        y: Any,
        *,
        sampling_time: float | None = None,
        inputs: Sequence[str | Signal] | None = None,
        outputs: Sequence[str | Signal] | None = None,
    ) -> Self:
        """Search for a model.

        u, y: inputs (T, nu) and outputs (T, ny) in physical units, arrays (T,) of one channel, data
        frames, or lists of them, one a record. sampling_time in seconds; None takes it from the
        index of the data frames: dates, or numbers in seconds. The index is treated as `asia init`
        treats the time stamps of files: a little jitter counts as none, more is resampled, and a
        record is cut at gaps. inputs, outputs: names, or `asia.Signal`s with units. The
        same call again resumes. Raises UserError for anything the caller can mend.
        """
        us, ys = one_a_record(u), one_a_record(y)
        signals = name_signals(inputs, us[0], "u"), name_signals(outputs, ys[0], "y")
        step = read_arrays(us, ys, *signals, sampling_time, "train").records[0].sampling_time
        problem = Problem.from_arrays(
            u,
            y,
            sampling_time=step,
            directory=self._directory(u, y, step, inputs, outputs),
            inputs=inputs,
            outputs=outputs,
            description=self.description,
            protocol=self.protocol,
            budget=self.budget,
            physics=self.physics,
            symmetry=self.symmetry,
            plant=self.plant,
        )
        if self.progress:
            for text in (*problem.readings, *problem.warnings):
                say(text)
        self.run_ = search_for_model(
            problem,
            agent=self.agent,
            experiments=self.experiments,
            seed=self.seed,
            runs=self.runs,
            sinks=(_Printer,) if self.progress else (),
        )
        return self

    def simulate(
        self, u: Any, *, past_u: Any = None, past_y: Any = None, bands: float | None = None
    ) -> Array | BandedSimulation:
        """Open-loop simulation: u (H, nu) -> y_hat (H, ny), physical units.

        past_u (n, nu), past_y (n, ny): the samples just before the first of u; the last ones are
        used, as many as the protocol says. bands: a level such as 0.9, for the bands that hold this
        share of the outputs. Raises UserError for a wrong shape, or before `fit`.
        """
        rule, (nu, ny) = self.problem_.protocol, self._channels
        case = (
            _past(past_u, rule.past_inputs, nu, "past_u"),
            _past(past_y, rule.past_outputs, ny, "past_y"),
            _table(u, nu, "u"),
        )
        directory = self._opened.directory
        if bands is None:
            return simulate(directory, *case, self.model)
        return simulate(directory, *case, self.model, bands=bands)

    def predict(self, u: Any, y: Any, horizon: int = 1) -> Array:
        """The prediction (T, ny) of each sample from the measured ones up to `horizon` samples
        before it, and the inputs; NaN where the record has no whole past window before that.

        u (T, nu), y (T, ny): a record in physical units. Raises UserError for a wrong shape.
        """
        rule, (nu, ny) = self.problem_.protocol, self._channels
        u, y = _table(u, nu, "u"), _table(y, ny, "y")
        if len(u) != len(y):
            raise UserError(f"u has {len(u)} samples, y {len(y)}: they must be one record")
        if horizon < 1:
            raise UserError(f"horizon is {horizon}, expected at least 1 sample")
        found = np.full((len(y), ny), np.nan)
        never = np.logical_and.accumulate(np.isnan(y)).any(axis=1)  # By this sample.
        first = max(rule.past, int(never.sum()) + 1 if rule.past_outputs else 0)
        starts = range(first, len(y) - horizon + 1)

        for first in range(0, len(starts), 4096):
            part = starts[first : first + 4096]
            cases = [
                (
                    u[k - rule.past_inputs : k],
                    past_outputs(y, k, rule.past_outputs, "y"),
                    u[k : k + horizon],
                )
                for k in part
            ]
            ends = simulate_cases(self._opened.directory, cases, self.model)
            found[[k + horizon - 1 for k in part]] = [end[-1] for end in ends]
        return found

    def score(self, u: Any, y: Any) -> float:
        """The fit index in percent of the simulation of one record, or of several: 100 is perfect,
        0 as good as the mean. The mean over outputs and records.

        Each record begins with the past window; the simulation starts behind it. Records are read
        by the rules of a test: outputs are never interpolated.
        """
        us, ys = one_a_record(u), one_a_record(y)
        problem, rule = self.problem_, self.problem_.protocol
        signals = problem.channels.inputs, problem.channels.outputs
        step = problem.channels.sampling_time
        records = read_arrays(us, ys, *signals, step, "record", "test").records
        for record in records:
            if len(record) <= rule.past + 1:
                raise UserError(
                    f"{record.name} has {len(record)} samples, the past window alone {rule.past}"
                )
        cases = [
            (
                r.u[rule.past - rule.past_inputs : rule.past],
                past_outputs(r.measured_y, rule.past, rule.past_outputs, r.name),
                r.u[rule.past :],
            )
            for r in records
        ]
        found = simulate_cases(self._opened.directory, cases, self.model)
        fits = [
            fit_index(r.measured_y[rule.past :], y_hat)
            for r, y_hat in zip(records, found, strict=True)
        ]
        return float(np.nanmean(np.stack(fits)))

    def export(self, to: str | Sequence[str], out: Path | str | None = None) -> list[Exported]:
        """Print the model as code for other programs, as `asia export`.

        to: a target such as `c`, or several; out: folder for a folder a target, by default `export`
        in the run. Each target is compared with ASIA's own simulation; raises UserError, and writes
        nothing, where they differ.
        """
        targets = [to] if isinstance(to, str) else list(to)
        folder = None if out is None else Path(out)
        return export_model(self._opened.directory, targets, self.model, folder)

    def linearize(self, at: str | None = None) -> Any:
        """Linear model at an operating point as `control.StateSpace`, with the names of the
        signals.

        at: `u=2.5` (inputs held), `y=9` (outputs to reach) or `start`; default: the mean inputs.
        Raises UserError where there is no such point, several, or no python-control.
        """
        found = linearize(self._opened, [] if at is None else [at])
        point, *others = found.points
        if others:
            rests = ", ".join(str(one.at.y.tolist()) for one in found.points)
            raise UserError(f"the model rests at several outputs, {rests}: give one as at='y=...'")
        names = [one.name for one in found.inputs], [one.name for one in found.outputs]
        return point.model.control(*names)

    def report(self) -> tuple[Path, ...]:
        """Write pictures and the page of the run; their paths."""
        directory = self._opened.directory
        return (*write_report(directory), write_page(directory))

    @property
    def problem_(self) -> Problem:
        """The problem, as the search had it."""
        return load_lock(self._opened.directory / LOCK)

    @property
    def value_(self) -> float:
        """V of the best candidate."""
        best = self._opened.view.best
        assert best is not None
        assert best.score is not None
        return best.score.value

    @property
    def verdict_(self) -> Usability:
        """The verdict on the model to use, as every command prints it."""
        found = usability(open_run(self._opened.directory).view)
        assert found is not None
        return found

    @property
    def source_(self) -> str:
        """The best candidate's code."""
        best = self._opened.view.best
        assert best is not None
        return self._opened.store.text(best.source)

    @property
    def parameters_(self) -> pd.DataFrame | tuple[IdentifiedParameter, ...]:
        """The parameters of the model fitted to all records, with their uncertainty: a data frame,
        one row a parameter, or without pandas a tuple of objects.

        Columns: `value`, `unit`, `standard_error`; `low` and `high`, the 95 % interval that
        `asia show` prints; `fold_error`, the standard error by the spread of the fold models;
        `lower` and `upper`, the search range; `identifiable`, whether the records determine it. No
        rows where the best candidate has no parameters. Without a refit the values are means over
        the fold models.
        """
        model = identified(self._opened)
        found = () if model is None else model.parameters
        try:
            import pandas as pd
        except ImportError:
            return found
        estimates = ("value", "unit", "standard_error")
        rows = [
            {
                **{name: getattr(one.fitted, name) for name in estimates},
                **dict(zip(("low", "high"), one.interval or (None, None), strict=True)),
                "fold_error": one.fold_error,
                **{name: getattr(one.fitted, name) for name in ("lower", "upper", "identifiable")},
            }
            for one in found
        ]
        names = pd.Index([one.fitted.name for one in found], name="parameter")
        columns = [*estimates, "low", "high", "fold_error", "lower", "upper", "identifiable"]
        frame = pd.DataFrame(rows, index=names, columns=columns)
        numbers = [name for name in columns if name not in ("unit", "identifiable")]
        return frame.astype(dict.fromkeys(numbers, float))

    def __repr__(self) -> str:
        own, usual = self.get_params(), inspect.signature(type(self)).parameters
        arguments = [f"{k}={v!r}" for k, v in own.items() if v is not usual[k].default]
        return f"SystemIdentifier({', '.join(arguments)})"

    def _repr_html_(self) -> str:
        """Show V, the model to use, its equations and a picture in notebooks."""
        if not hasattr(self, "run_") or self.run_.view.best is None:
            return f"<code>{repr(self).replace('<', '&lt;')}</code>"
        return brief_html(self.run_.directory)

    @property
    def _opened(self) -> Run:
        if not hasattr(self, "run_"):
            raise UserError("there is no model yet: call fit(u, y, sampling_time=...) first")
        if model_to_use(self.run_.view) is None:
            name = self.run_.name
            raise UserError(f"no candidate of run '{name}' has a score: asia show {name} says why")
        return self.run_

    @property
    def _channels(self) -> tuple[int, int]:
        return len(self.problem_.inputs), len(self.problem_.outputs)

    def _directory(self, u: Any, y: Any, step: float, inputs: object, outputs: object) -> Path:
        if self.directory is not None:
            return Path(self.directory)
        # Named by a digest of records and settings, so that the same ones have the same name.
        records = [one for values in (u, y) for one in one_a_record(values)]
        times = [
            str(np.asarray(one.index).tolist())
            for one in records
            if hasattr(one, "columns") and hasattr(one, "index")
        ]
        given = step, inputs, outputs, self.protocol, self.budget, self.physics
        plant = () if self.plant is None else plant_file(self.plant)
        settings = (*given, self.symmetry, self.description, *plant, *times)
        digest = hashlib.sha256(repr(settings).encode())
        for record in records:
            array = real_numbers(record, "a record")
            digest.update(repr(array.shape).encode() + array.astype("<f8").tobytes())
        return Path(self.runs) / "problems" / f"records-{digest.hexdigest()[:8]}"


@dataclass(frozen=True)
class _Printer:
    """Prints a line for each experiment."""

    directory: Path
    view: SearchView

    def event(self, event: Event, view: SearchView) -> None:
        """Print the result of an experiment."""
        if isinstance(event, Evaluated):
            say(experiment_line(view.experiment(event.experiment), view))

    def close(self) -> None:
        """Close without effect."""


def _parameters() -> list[str]:
    return list(inspect.signature(SystemIdentifier).parameters)


def _table(values: Any, channels: int, name: str) -> Array:
    """(T, channels). Raises UserError for another shape."""
    found = real_numbers(values, name)
    found = found[:, None] if found.ndim == 1 else found
    if found.ndim != 2 or found.shape[1] != channels:
        raise UserError(f"{name} has shape {np.shape(values)}, expected (samples, {channels})")
    return found


def _past(values: Any, samples: int, channels: int, name: str) -> Array:
    """The last samples (samples, channels)."""
    if values is None:
        if samples == 0:
            return np.zeros((0, channels))
        raise UserError(
            f"{name} is missing: the model starts from the {samples} samples before the first of u"
        )
    found = _table(values, channels, name)
    if len(found) < samples:
        raise UserError(f"{name} has {len(found)} samples, expected at least {samples}")
    return found[len(found) - samples :]
