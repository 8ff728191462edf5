"""A run directory opened for reading."""

import tomllib
import traceback
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from asia._diagnostic import error_sentence
from asia._text import one_line
from asia.errors import UserError
from asia.judge.evaluation.results import SUSPICIOUS_RATIO, consistency
from asia.judge.scoring.checks.check import Verdict
from asia.judge.scoring.outcome import Failure, Score
from asia.ledger.artifacts import Store
from asia.ledger.chain import Line, in_use, ledger_of, read_lines, write_whole
from asia.ledger.events import Started, StressTest, TestedModel, Unsealed, Use
from asia.ledger.view import FAR_ABOVE_V, SearchView, replay

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


def stress_text(test: StressTest) -> str:
    """Describe what a model did on training inputs in other combinations, in a sentence."""
    start = f"On training inputs in other combinations the {test.model}"
    if test.reach is None:
        return f"{start} gives no finite outputs within the time limit."
    return (
        f"{start} takes {test.output} {test.reach:.3g} times as far from the middle of its "
        "training range as any measured output."
    )


@dataclass(frozen=True)
class Usability:
    """Verdict on the model to use."""

    kind: Literal["usable", "doubtful", "not usable"]
    reasons: tuple[str, ...]
    """Sentences, the most important first; empty for a usable model."""


# Ratios of V to that of the mean or of the linear model from which on a model is not, or hardly,
# better; of the largest to the smallest V of the folds, and of other seeds, that are doubtful.
NO_BETTER, _FOLDS_APART, _SEEDS_APART = 0.95, 4.0, 2.0
# Difference between fold models on the training records, in standard deviations of the output.
_MODELS_APART = 0.5


def usability(view: SearchView) -> Usability | None:
    """Judge the model to use by the ledger alone; None while there is no model.

    Not usable: worse than the mean of the output in a fold, diverges in the stress simulation,
    contradicted by the test or a heavy check. Doubtful: folds, fold models, seeds or repeated fits
    differ, a nonlinear model is no better than the linear one, a light check does not pass, or the
    candidate or the agent could see held-out data.
    """
    best = view.best
    if best is None or best.score is None:
        return None
    value, values = best.score.value, [fold.value for fold in best.score.folds]
    refitted = view.refitted
    is_stack = refitted is not None and refitted.use == "stack" and refitted.stack is not None
    if refitted is not None and refitted.stack is not None and is_stack:
        value, values = refitted.stack.value, list(refitted.stack.folds)
    wrong, doubts = [f"{text[:1].upper()}{text[1:]}." for text in alarms(view)], list[str]()
    references = {r.name: r.outcome for r in view.references if isinstance(r.outcome, Score)}
    mean, linear = references.get("training mean"), references.get("linear model")
    worse = [
        k + 1 for k, own in enumerate(values) if mean is not None and own >= mean.folds[k].value
    ]
    if mean is not None and (worse or value >= NO_BETTER * mean.value):
        where = f" in fold {', '.join(map(str, worse))}" if worse else ""
        wrong.append(
            f"It is {'worse' if worse else 'no better'} than the mean of the output{where} "
            f"(V {value:.3g}, mean {mean.value:.3g})."
        )
        wrong.append(
            (refitted.cause if refitted is not None else "")
            or view.experiments[-1].proposed.remark
            or "Do the inputs act on the outputs? Was the plant in closed loop? Is it unstable? "
            "Read the output of asia check. For an unstable plant use short windows: "
            'kind = "windows" in [protocol].'
        )
    if refitted is not None and (loop := refitted.feedback) is not None:
        many = len(loop.inputs) > 1
        who = f"Input{'s' * many} {', '.join(loop.inputs)} follow{'s' * (not many)} earlier outputs"
        help = "Name the measured reference in [loop]."
        if loop.declared:
            doubts.append(
                "The records come from a closed loop, and this model was fitted as if they did "
                "not: its gains may be biased, which V on such records does not show. Compare "
                + (f"#{loop.sound:02d}, " if loop.sound is not None else "")
                + 'linear with loop = "direct", or set inputs = "explained" in [loop].'
            )
        elif loop.pole is not None:
            wrong.append(
                f"{who}, and the plant between them is unstable (largest pole {loop.pole:.3g}): a "
                f"controller holds it, and this model describes both. {help}"
            )
        else:
            doubts.append(f"{who}: in closed loop the model may describe the controller. {help}")
    test = refitted.stress[-1] if refitted is not None and refitted.stress else None
    failed = refitted.failed_checks if refitted is not None else ()
    if any("stress simulation" in line for line in failed):
        doubts.append("The stress simulation failed, so nothing is known of other inputs.")
    if test is not None and test.outcome != "bounded":
        advice = "Record more levels, each input with steps of its own."
        if test.outcome != "diverges":
            advice = f"Is the plant an integrator? If not: {advice[:1].lower()}{advice[1:]}"
        (wrong if test.outcome == "diverges" else doubts).append(f"{stress_text(test)} {advice}")
    for validation in view.validated:
        where = f" on the record {validation.record}" if validation.record else ""
        for check in validation.checks:
            if check.verdict in (Verdict.DOUBT, Verdict.FAIL):
                ends = "fails" if check.verdict is Verdict.FAIL else "is in doubt"
                cause = f" ({check.cause})" if check.cause else ""
                sentence = f"The check '{check.name}' {ends}{where}{cause}."
                (wrong if check.weight > 1.0 else doubts).append(sentence)
    if linear is not None and value > linear.value:
        doubts.append(f"It is worse than a linear model (V {value:.3g}, {linear.value:.3g}).")
    elif (
        linear is not None
        and value > NO_BETTER * linear.value
        and best.proposed.family not in ("linear", "arx")
        and best.score.value != linear.value  # The baseline is that model.
    ):
        doubts.append(f"It is hardly better than a linear model (V {linear.value:.3g}).")
    if max(values) > _FOLDS_APART * min(values):
        doubts.append(
            f"V of the folds is {min(values):.3g} to {max(values):.3g}: record more of what only "
            "one part of the records shows."
        )
    seeds = () if is_stack else best.seed_values
    if seeds and max(seeds) > _SEEDS_APART * min(seeds):
        doubts.append(f"Other seeds give V from {min(seeds):.3g} to {max(seeds):.3g}.")
    check = None if refitted is None or is_stack else refitted.check
    apart = check.fold_disagreement if check is not None else None
    if apart is not None and apart > _MODELS_APART:
        doubts.append(
            f"The fold models differ by {apart:.2g} standard deviations of the output: record "
            "longer."
        )
    start, again = view.started, refitted.again if refitted is not None else None
    errors = [f.diagnostics.train_error for f in best.result.folds] if best.result else []
    deadline = best.result is not None and best.result.deadline
    doubts += [
        sentence
        for holds, sentence in (
            (bool(unguarded(view)), unguarded(view)),
            (
                start.isolation == "process",
                "Candidates ran without isolation and could have read the held-out data.",
            ),
            (
                start.early_stopping == "validation",
                "Candidates saw their score on the held-out data during training.",
            ),
            (start.residuals == "held_out", "The agent saw held-out residuals."),
            (
                again is not None and (again.ratio is None or abs(again.ratio - 1.0) > 0.01),
                "A second fit of the winner failed or gave another error.",
            ),
            (
                consistency(best.score.value, errors) < SUSPICIOUS_RATIO,
                "The error on held-out data is far below that on training data.",
            ),
            (deadline, "The winner's fit reached its deadline, so it depends on the machine."),
        )
        if holds
    ]
    kind = "not usable" if wrong else "doubtful" if doubts else "usable"
    return Usability(kind, (*wrong, *doubts))


def unguarded(view: SearchView) -> str:
    """Return why V alone stands for the result of a search; "" where it is evidence, or where
    guard records confirm it."""
    if not view.started.gate or view.started.guard_digest is not None:
        return ""
    return (
        "V alone proves little here: the agent could read the training records, and no guard "
        "records are held back to confirm it. Record more, or name some in data.guard."
    )


def tested_model(record: Unsealed, use: Use) -> TestedModel | Failure:
    """The result of the sealed test for this model; that of the ensemble if it has none."""
    found = {"ensemble": record.ensemble, "refit": record.refit, "stack": record.stack}[use]
    return record.ensemble if found is None else found


def alarms(view: SearchView) -> tuple[str, ...]:
    """Return what is said before everything else: a test error far above V, a gain that the guard
    records contradict, and a V that no model can have."""
    found: list[str] = []
    best = view.best
    if best is None or best.score is None:
        return ()
    value, named = best.score.value, model_to_use(view)
    if view.unsealed is not None and named is not None:
        model = tested_model(view.unsealed, named.model)
        error = model.error if isinstance(model, TestedModel) else None
        if error is not None and error > FAR_ABOVE_V * value > 0:
            found.append(
                f"the test error is {error / value:.3g} times V, far more than in honest searches "
                f"that went well ({FAR_ABOVE_V:g} at most): V is no measure of this model"
            )
    total = view.looks[-1].total if view.looks else None
    if total is not None and total.guard is not None and total.contradicted:
        since = f"since #{total.since:02d}" if total.since else "from the training mean"
        found.append(
            f"V fell by {total.gain:.0%} {since}, the error on the guard records by "
            f"{total.guard.value:.0%} (at most {total.guard.high:.0%}): V is no measure of this "
            "model"
        )
    if view.truth is not None and view.below_truth(value):
        found.append(
            f"V {value:.4g} of #{best.number:02d} is below that of the simulated truth, "
            f"{view.truth:.4g}, which no model can reach: the candidate contains held-out data"
        )
    return tuple(found)


# Result of the expert at the same budget, for comparison with a search that costs money.


# Agents without a control: the control itself, and those that are controls too.
FREE = ("expert", "random", "random-paper", "bayes")
CONTROL = "expert"


@dataclass(frozen=True)
class Control:
    """`run` of the control agent and its best V within the first `experiments`; None while there is
    no such run, or no score in it."""

    run: str | None
    value: float | None
    experiments: int


def control(directory: Path, start: Started, spent: int) -> Control | None:
    """Return the control run of a search, or None for agents that need none.

    Of several control runs in the same folder, the one with the same seed counts, else the first.
    spent: number of experiments that the search has spent.
    """
    if start.agent in FREE or spent == 0:
        return None
    own = directory.resolve()
    found: list[tuple[bool, str, Path]] = []
    for ledger in sorted(own.parent.glob("*/ledger.jsonl")):
        if ledger.parent == own:
            continue
        try:
            first = next(read_lines(ledger), None)
        except UserError:
            continue
        other = None if first is None else first.event
        if (
            isinstance(other, Started)
            and other.agent == CONTROL
            and other.problem == start.problem
            and other.protocol_digest == start.protocol_digest
            and other.early_stopping == start.early_stopping
        ):
            found.append((other.seed != start.seed, other.run, ledger.parent))
    for _, name, place in sorted(found):
        try:
            view = open_run(place).view
        except UserError:
            continue
        finished = view.finished[:spent]
        if len(finished) == spent or view.stopped is not None:
            values = [e.score.value for e in finished if e.score]
            return Control(name, min(values, default=None), spent)
    return Control(None, None, spent)
