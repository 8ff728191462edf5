"""Validation of the model of a run: probes in the sandbox, checks, record."""

from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import cast

import numpy as np

from asia._diagnostic import diagnostic
from asia._plugins import parts_of
from asia._progress import tracked
from asia._text import one_line
from asia.data.intake.sheet import Wanted
from asia.data.segment import Segment
from asia.data.trajectory import Array, Trajectory, data_digest, filled
from asia.errors import CandidateError, Reason, UserError
from asia.judge.evaluation.evaluator import Evaluator
from asia.judge.sandbox.types import Isolation
from asia.judge.scoring.bands import HeldOutErrors, error_sizes
from asia.judge.scoring.checks.check import Check, Verdict, most_serious
from asia.judge.scoring.checks.errors import (
    check_bands,
    check_largest_error,
    check_overfit,
    check_region,
    check_steps_ahead,
    no_bands,
    no_steps_ahead,
)
from asia.judge.scoring.checks.residual import residual_checks
from asia.judge.scoring.checks.response import (
    HORIZONS,
    SMALL,
    check_frequency_response,
    check_gain,
    check_long_run,
    check_responses,
    check_spectrum,
    impulse_response,
)
from asia.judge.scoring.checks.validation_data import (
    LinearResponse,
    SimulatedSegments,
    ValidationCheck,
    ValidationData,
)
from asia.ledger.artifacts import without_artifacts
from asia.ledger.chain import Chain
from asia.ledger.events import RecordedCheck, Use, Validated
from asia.ledger.evidence import folds_of, identified, put_curves
from asia.ledger.run import Run, model_to_use, open_run
from asia.ledger.view import Experiment
from asia.problem.check import responses
from asia.problem.folds import past_outputs, whole
from asia.problem.load import load_lock, read_records
from asia.problem.problem import Problem
from asia.search.run import LOCK, make_evaluator
from asia.search.simulation import (
    BAND_LEVEL,
    BandBasis,
    FinalMember,
    band_basis,
    final_members,
    models_behind,
    simulate_members,
)

_GROUP = "asia.validation_checks"


VALIDATION_CHECKS: dict[str, ValidationCheck] = {
    "residuals": residual_checks,
    "direction of gain": check_gain,
    "error spectrum": check_spectrum,
    "frequency response": check_frequency_response,
    "static gain": check_responses,
    "ten horizons": check_long_run,
    "largest error": check_largest_error,
}
"""The built-in checks, in the order to read them."""


def validation_checks() -> dict[str, ValidationCheck]:
    """All checks by name: the built-in ones, then those of installed packages. Raises UserError
    where an installed package brings a check that is taken by name or cannot be called."""
    found = dict(VALIDATION_CHECKS)
    for part in parts_of(_GROUP):
        package = f"validation check '{part.name}' of package {part.package} {part.version}"
        if part.name in VALIDATION_CHECKS:
            raise UserError(f"{package}: ASIA has a check of this name; rename the entry point")
        check = part.load()
        if not callable(check):
            raise UserError(f"{package} is {check!r}, expected a function of one ValidationData")
        found[part.name] = cast("ValidationCheck", check)
    return found


# Probes of a model beyond its held-out samples: small steps, a long run, later starts.


Simulator = Callable[[Sequence[Segment]], Sequence[Array]]

_POINTS = {"low inputs": 0.25, "middle inputs": 0.5, "high inputs": 0.75}
_SETTLING = 300
_AHEAD = 50


@dataclass(frozen=True)
class ProbeRange:
    """Ranges and records of the training data for probes."""

    records: tuple[Trajectory, ...]
    past_inputs: int
    past_outputs: int

    @property
    def past(self) -> int:
        """Samples of the longer past window."""
        return max(self.past_inputs, self.past_outputs)

    def block(self, u: Array, y: Array | None = None) -> Segment:
        """Inputs (past + H, nu) as a block that starts from the mean output or y (past, ny)."""
        past, ny = self.past, self.records[0].y.shape[1]
        mean = np.concatenate([r.y for r in self.records]).mean(axis=0)
        past_y = (
            np.tile(mean, (self.past_outputs, 1)) if y is None else y[past - self.past_outputs :]
        )
        # All of one record: a request then holds one segment, whatever its length.
        past_u, ahead = u[past - self.past_inputs : past], np.zeros((len(u) - past, ny))
        return Segment(past_u, past_y, u[past:], ahead)


def linear_responses(
    given: ProbeRange, names: Sequence[str], simulate: Simulator
) -> tuple[LinearResponse, ...]:
    """Small steps up and down of each input, after the inputs were held at an operating point;
    () where the model has no finite answer."""
    inputs = np.concatenate([r.u for r in given.records])
    deviation, past = inputs.std(axis=0), given.past
    asked = [
        (point, number)
        for point in _POINTS
        for number in range(min(len(names), 4))
        if deviation[number] > 0.0
    ]
    blocks: list[Segment] = []
    for point, number in asked:
        held = np.tile(np.quantile(inputs, _POINTS[point], axis=0), (past + 2 * _SETTLING, 1))
        for sign in (1.0, -1.0):
            moved = held.copy()
            moved[past + _SETTLING :, number] += sign * SMALL * deviation[number]
            blocks.append(given.block(moved))
    try:
        found = [y_hat[_SETTLING:] for y_hat in simulate(blocks)]
    except CandidateError as error:
        if error.reason is not Reason.NOT_FINITE:
            raise
        return ()
    return tuple(
        LinearResponse(
            point, names[number], impulse_response(up, down, SMALL * float(deviation[number]))
        )
        for (point, number), up, down in zip(asked, found[::2], found[1::2], strict=True)
    )


def long_run(given: ProbeRange, horizon: int | None, simulate: Simulator) -> Array | None:
    """Ten horizons (n, ny) with the longest record's inputs repeated; None if not finite."""
    record = max(given.records, key=len)
    past = given.past
    length = HORIZONS * min(2000, horizon or len(record))
    u = np.tile(record.u[past:], (-(-length // (len(record) - past)), 1))[:length]
    block = given.block(np.concatenate([record.u[:past], u]), record.y[:past])
    try:
        return simulate([block])[0]
    except CandidateError as error:
        if error.reason is not Reason.NOT_FINITE:
            raise
        return None


def starts(given: ProbeRange, blocks: Sequence[Segment]) -> list[Segment]:
    """Short blocks inside long ones, begun from measured samples; [] without past or room."""
    past = given.past
    long = [b for b in blocks if len(b.y) >= 2 * past + 2 * _AHEAD]
    if past == 0 or not long:
        return []
    each = max(1, 24 // len(long))
    found: list[Segment] = []
    for block in long:
        for at in np.linspace(past, len(block.y) - _AHEAD, each).astype(int).tolist():
            ahead, before = block.y[at : at + _AHEAD], block.y[:at]
            if np.isnan(ahead).all(axis=0).any() or np.isnan(before).all(axis=0).any():
                continue
            later = replace(
                block,
                past_u=block.u[at - given.past_inputs : at],
                past_y=past_outputs(block.y, at, given.past_outputs, block.name),
                u=block.u[at : at + _AHEAD],
                y=ahead,
                record=0,
                start=block.start + at,
            )
            found.append(later)
    return found


# Make the validation report of a run: held-out simulations from the ledger, further answers in the
# sandbox.
#
# It uses training records alone, and a record that the user brings. The sealed test stays closed.


@dataclass(frozen=True)
class ValidationReport:
    """Validation report: all checks of the model to use."""

    run: str
    checks: tuple[Check, ...]
    event: Validated
    """The report as the ledger keeps it."""
    recorded: bool
    """True if the ledger, and so the page, has it; not before the search is finished."""


def validate(
    directory: Path,
    record: Path | None = None,
    progress: Callable[[str], None] = lambda text: None,
    reading: Wanted | None = None,
    isolation: Isolation | None = None,
) -> ValidationReport:
    """Validate the model to use of a run.

    Without a record, residuals are those of the fold models on their held-out samples. With one,
    the model to use simulates it from its first past window. The validation of a finished search is
    recorded in its ledger.

    Args:
        record: new record; a file of several experiments is validated on all of them.
        progress: called with a description of the current step.
        reading: options for the record, in place of those of the problem.
        isolation: level of the candidate; None for the strongest of this machine.

    Raises:
        UserError: the run has no scored model or came without its artifacts, or the record cannot
            be read.
        CandidateError: the model cannot simulate the record.
    """
    run = open_run(directory)
    chosen, best = model_to_use(run.view), run.view.best
    if chosen is None or best is None:
        raise UserError(f"run '{run.name}' has no scored model, so nothing to validate")
    if not run.store.kept:
        raise UserError(without_artifacts(directory))
    problem = load_lock(directory / LOCK)
    evaluator = make_evaluator(problem, run.view, isolation=isolation)
    work = _Validation(run, problem, evaluator, best, chosen.model, progress)
    new = () if record is None else read_records(problem, record, reading)
    checks = work.new_records(new) if new else work.held_out()
    recorded, worst = run.view.complete, most_serious(checks)
    event = Validated(
        experiment=best.number,
        model=chosen.model,
        record="" if record is None else record.name,
        record_digest=data_digest(new) if new else "",
        checks=tuple(
            RecordedCheck(
                name=one.name,
                verdict=one.verdict,
                # A line of the ledger has room for all checks.
                sentence=one_line(one.sentence, 2000),
                cause="" if one.cause is None else str(one.cause),
                weight=round(one.weight, 4),
            )
            for one in checks
        ),
        curves=put_curves(run.store, checks) if recorded else "",
        passed=sum(c.verdict is Verdict.PASS for c in checks),
        doubtful=sum(c.verdict is Verdict.DOUBT for c in checks),
        failed=sum(c.verdict is Verdict.FAIL for c in checks),
        worst="" if worst is None else worst.name,
        after_unsealing=run.view.unsealing is not None,
    )
    if recorded:
        with Chain(directory / "ledger.jsonl") as chain:
            event = replace(event, after_unsealing=chain.view.unsealing is not None)
            if event not in chain.view.validated:
                chain.append(event)
    return ValidationReport(run.name, checks, event, recorded)


@contextmanager
def _diagnostic_of_model(name: str, failed: list[str]) -> Generator[None]:
    """As `diagnostic`, for a block in which the model may fail too, for example by its time."""
    with diagnostic(name, failed):
        try:
            yield
        except CandidateError as error:
            failed.append(f"check {name} failed: {error.reason.advice}")


def _run_check(name: str, make: Callable[[], Check | tuple[Check, ...]]) -> tuple[Check, ...]:
    """The checks, or one that says why they failed."""
    failed: list[str] = []
    with _diagnostic_of_model(name, failed):
        found = make()
        return found if isinstance(found, tuple) else (found,)
    return (Check(name, Verdict.ABSENT, failed[0]),)


@dataclass(frozen=True)
class _Validation:
    """A validation report under way."""

    run: Run
    problem: Problem
    evaluator: Evaluator
    best: Experiment
    use: Use
    progress: Callable[[str], None]

    def held_out(self) -> tuple[Check, ...]:
        """The validation report on what the folds held out."""
        basis = self._basis
        pairs = [
            (block, y_hat)
            for fold, simulated in zip(self.evaluator.data.folds, basis.simulated, strict=True)
            for block, y_hat in zip(fold.held_out, simulated, strict=True)
        ]
        found = self._simulations(pairs, self.problem.train)
        windows = self.evaluator.data.horizon is not None
        return (
            *self._registered_checks(found),
            *_run_check("held-out error", lambda: self._check_overfit(found)),
            *_run_check("training records", self._training_records),
            *_run_check(
                "steps ahead",
                lambda: self._check_windows(pairs) if windows else self._check_starts(),
            ),
            *_run_check("region of validity", lambda: check_region(found, basis.region)),
            *_run_check("output bands", lambda: self._check_left_out(basis)),
        )

    def new_records(self, records: Sequence[Trajectory]) -> tuple[Check, ...]:
        """The validation report on new records."""
        blocks = whole(records, self.problem.protocol)
        if not blocks:
            raise UserError(
                f"record '{records[0].name}' is too short: it holds no case to simulate"
            )
        y_hat = self._simulator(final_members(self.run.view, self.use))(blocks)
        pairs = list(zip(blocks, y_hat, strict=True))
        found, basis = self._simulations(pairs, records), self._basis
        windows = self.evaluator.data.horizon is not None
        return (
            *self._registered_checks(found),
            *(_run_check("steps ahead", lambda: self._check_windows(pairs)) if windows else ()),
            *_run_check("region of validity", lambda: check_region(found, basis.region)),
            *_run_check("output bands", lambda: self._check_bands(basis, blocks, y_hat)),
        )

    @property
    def _basis(self) -> BandBasis:
        return band_basis(self.evaluator, self.run.view, self.run.store, self.use)

    def _check_overfit(self, found: SimulatedSegments) -> tuple[Check, ...]:
        """Check for overfitting; () for an older ledger."""
        folds = folds_of(self.run.store, self.best)
        if not all(f.errors for f in folds):
            return ()
        train = [float(np.mean(f.train_errors)) for f in folds]
        held = [float(np.mean(f.errors)) for f in folds]
        named = identified(self.run)
        apart = () if named is None else named.disagreeing
        numbers = [f.numbers for f in folds if f.numbers is not None]
        return (check_overfit(train, held, found, apart, max(numbers, default=None)),)

    def _training_records(self) -> tuple[Check, ...]:
        """Show which checks do not pass on the training records of a fold, which agents see and
        `asia show` prints; () where all pass."""
        folds = folds_of(self.run.store, self.best)
        failed = [
            f"{', '.join(one.name for one in fold.checks)} (fold {number})"
            for number, fold in enumerate(folds, 1)
            if fold.checks
        ]
        if not failed:
            return ()
        sentence = (
            "on the training records of single folds some checks do not pass: "
            f"{'; '.join(failed)}. The verdicts of this report are those on the held-out parts"
        )
        return (Check("training records", Verdict.SHOWN, sentence),)

    def _check_bands(
        self, basis: BandBasis, blocks: Sequence[Segment], y_hat: Sequence[Array]
    ) -> Check:
        """Check the coverage of a new record by the output bands."""
        behind = models_behind(self.run.view, self.use)
        self.progress("output bands")
        try:
            each = simulate_members(self.evaluator, self.run, behind, blocks)
        except CandidateError:
            return no_bands("a fold model does not simulate this record")
        held, known, errors = 0.0, 0, list[Array]()
        for block, folds, mean in zip(blocks, each, y_hat, strict=True):
            bands, _ = basis.around(block, folds, mean, BAND_LEVEL)
            inside = (bands.lower <= block.y) & (block.y <= bands.upper)
            held, known = held + inside.sum(axis=0), known + (~np.isnan(block.y)).sum(axis=0)
            errors.append(block.y - mean)
        worth = np.array(error_sizes([HeldOutErrors(tuple(errors))]).independent)
        return self._banded(basis, held / np.maximum(known, 1), worth)

    def _check_left_out(self, basis: BandBasis) -> Check:
        """Check the coverage of each fold by the bands of the other folds."""
        worth = np.array(error_sizes(basis.errors, by_step=basis.windows).independent)
        return self._banded(basis, basis.calibration.held.mean(axis=0), worth)

    def _banded(self, basis: BandBasis, held: Array, independent: Array) -> Check:
        outputs = [s.name for s in self.problem.outputs]
        return check_bands(held, independent, outputs, BAND_LEVEL, basis.calibration.withdrawn)

    def _simulations(
        self, pairs: Sequence[tuple[Segment, Array]], records: Sequence[Trajectory]
    ) -> SimulatedSegments:
        return SimulatedSegments(
            tuple(block.simulated(y_hat) for block, y_hat in pairs),
            tuple(s.name for s in self.problem.inputs),
            tuple(s.name for s in self.problem.outputs),
            self.problem.sampling_time,
            tuple(r.name for r in records),
        )

    def _registered_checks(self, found: SimulatedSegments) -> tuple[Check, ...]:
        """Return the checks of the registry."""
        simulator = self._simulator(final_members(self.run.view, self.use))
        given = self._probe_range
        self.progress("responses to small steps")
        failed: list[str] = []
        linear: tuple[LinearResponse, ...] = ()
        with _diagnostic_of_model("small steps", failed):
            linear = linear_responses(given, found.inputs, simulator)

        def noise() -> list[float | None]:
            return [None if r is None else r.levels.noise for r in responses(self.problem)]

        y = np.concatenate([r.y for r in self.evaluator.data.records])
        data = ValidationData(
            simulations=found,
            linear_responses=linear,
            lowest=y.min(axis=0),
            highest=y.max(axis=0),
            noise=noise,
            long_run=lambda: long_run(given, self.evaluator.data.horizon, simulator),
            fit=self.best.fit,
        )
        checks = [Check("small steps", Verdict.ABSENT, line) for line in failed]
        for name, check in tracked(tuple(validation_checks().items()), "check"):
            checks += _run_check(name, partial(check, data))
        return tuple(checks)

    @property
    def _probe_range(self) -> ProbeRange:
        rule = self.problem.protocol
        return ProbeRange(self.evaluator.data.records, rule.past_inputs, rule.past_outputs)

    def _check_windows(self, pairs: Sequence[tuple[Segment, Array]]) -> Check:
        """Check windows, each of which starts anew."""
        past = self.problem.protocol.past_outputs
        hold = np.stack([filled(b.y - b.past_y[-1]) for b, _ in pairs]) if past else None
        errors = np.stack([filled(b.y - y_hat) for b, y_hat in pairs])
        return check_steps_ahead(errors, hold, self.evaluator.data.scale)

    def _check_starts(self) -> Check:
        """Each fold's model from starts within what it did not fit."""
        if self.problem.protocol.past_outputs == 0:
            return no_steps_ahead("the protocol has no past outputs from which a model could start")
        self.progress("steps ahead, from many starts")
        member = final_members(self.run.view, "ensemble")[0]
        model_errors: list[Array] = []
        hold_errors: list[Array] = []
        for fold, name in zip(self.evaluator.data.folds, member.models, strict=True):
            blocks = starts(self._probe_range, fold.held_out)
            if not blocks:
                continue
            one = FinalMember(member.source, (name,))
            try:
                replies = self._simulator([one])(blocks)
            except CandidateError as error:
                if error.reason is not Reason.NOT_FINITE:
                    raise
                continue
            for block, reply in zip(blocks, replies, strict=True):
                model_errors.append(filled(block.y - reply))
                hold_errors.append(filled(block.y - block.past_y[-1]))
        if not model_errors:
            return no_steps_ahead(
                "no held-out part is long enough for a start, or no simulation was finite"
            )
        scale = self.evaluator.data.scale
        return check_steps_ahead(np.stack(model_errors), np.stack(hold_errors), scale)

    def _simulator(self, members: Sequence[FinalMember]) -> Simulator:
        """Simulations by a final model, in the sandbox."""

        def simulate(blocks: Sequence[Segment]) -> list[Array]:
            each = simulate_members(self.evaluator, self.run, members, blocks)
            return [y_hat.mean(axis=0) for y_hat in each]

        return simulate
