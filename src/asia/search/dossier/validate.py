"""Make the dossier of a run: held-out simulations from the ledger, further answers in the sandbox.

It uses training records alone, and a record that the user brings. The sealed test stays closed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from asia._boundary import diagnostic
from asia.data import Array, Trajectory, filled
from asia.errors import CandidateError, UserError
from asia.evaluation import Evaluator
from asia.ledger import (
    Experiment,
    Run,
    Store,
    Use,
    findings_of,
    identified,
    model_to_use,
    open_run,
    without_artifacts,
)
from asia.problem.frequency import responses
from asia.problem.load import Problem, Wanted, load_lock, read_records
from asia.protocol import Block, whole
from asia.scoring.dossier import (
    Check,
    LinearResponse,
    SimulatedBlock,
    SimulatedBlocks,
    ValidationData,
    Verdict,
    check_ahead,
    check_bands,
    check_overfit,
    check_region,
    no_bands,
    no_steps_ahead,
    summary,
    validation_checks,
)
from asia.search._run import LOCK, make_evaluator
from asia.search._simulate import simulate_members
from asia.search.dossier.probes import ProbeRange, Simulator, linear_responses, long_run, starts
from asia.search.dossier.recording import record_dossier
from asia.search.final.bands import BAND_LEVEL, BandBasis, band_basis, models_behind
from asia.search.final.members import FinalMember, final_members


@dataclass(frozen=True)
class Dossier:
    """Validation report: all checks of the model to use."""

    run: str
    """The run."""
    experiment: int
    """Its winner, 1-based."""
    model: Use
    """Final model that simulated the small steps and the long run."""
    record: str | None
    """The new record that was simulated; None for the held-out samples of the folds."""
    checks: tuple[Check, ...]
    """Checks in reading order."""
    recorded: bool
    """True if the ledger, and so the report, has it; not before the search is finished."""

    @property
    def summary(self) -> str:
        """Counts, and the sentence of the check that matters most."""
        return summary(self.checks)


def validate(
    directory: Path,
    record: Path | None = None,
    progress: Callable[[str], None] = lambda text: None,
    reading: Wanted | None = None,
) -> Dossier:
    """Validate the model to use of a run.

    Without a record, residuals are those of the fold models on their held-out samples. With one,
    the model to use simulates it from its first past window. The validation of a finished search is
    recorded in its ledger.

    Args:
        directory: run directory.
        record: new record; a file of several experiments is validated on all of them.
        progress: called with a description of the current step.
        reading: options for the record, in place of those of the problem.

    Raises:
        UserError: the run has no scored model, hides its scores, or came without its artifacts, or
            the record cannot be read.
        CandidateError: the model cannot simulate the record.
    """
    run = open_run(directory)
    chosen = model_to_use(run.view)
    if chosen is None or run.view.best is None:
        raise UserError(f"run '{run.name}' has no scored model, so nothing to validate")
    if run.view.started.ladder is not None:
        raise UserError(
            f"run '{run.name}' has ladder feedback, which hides the exact scores that a dossier "
            "prints: validate a run without it"
        )
    if not Store(directory / "artifacts").kept:
        raise UserError(without_artifacts(directory))
    problem = load_lock(directory / LOCK)
    evaluator = make_evaluator(problem, run.view)
    work = _Validation(run, problem, evaluator, run.view.best, chosen.model, progress)
    new = () if record is None else read_records(problem, record, reading)
    checks = work.on(new) if new else work.held_out()
    name = "" if record is None else record.name
    recorded = run.view.complete
    if recorded:
        record_dossier(directory, chosen.model, new, name, checks)
    return Dossier(run.name, run.view.best.number, chosen.model, name or None, checks, recorded)


def _made(name: str, make: Callable[[], Check | tuple[Check, ...]]) -> tuple[Check, ...]:
    """The checks, or one that says why they failed."""
    failed: list[str] = []
    with diagnostic(name, failed):
        found = make()
        return found if isinstance(found, tuple) else (found,)
    return (Check(name, Verdict.ABSENT, failed[0]),)


@dataclass(frozen=True)
class _Validation:
    """A dossier under way."""

    run: Run
    problem: Problem
    evaluator: Evaluator
    best: Experiment
    use: Use
    progress: Callable[[str], None]

    def held_out(self) -> tuple[Check, ...]:
        """The dossier on what the folds held out."""
        basis = band_basis(self.evaluator, self.run.view, self.run.store, self.use)
        pairs = [
            (block, y_hat)
            for fold, simulated in zip(self.evaluator.folds, basis.simulated, strict=True)
            for block, y_hat in zip(fold.validation, simulated, strict=True)
        ]
        blocks = tuple(
            SimulatedBlock(b.case.u, b.y, y_hat, b.record, b.start) for b, y_hat in pairs
        )
        found = self._simulations(blocks)
        windows = self.evaluator.horizon is not None
        return (
            *self._of_residuals(found),
            *_made("held-out error", lambda: self._overfit(found)),
            *_made("steps ahead", lambda: self._of_windows(pairs) if windows else self._ahead()),
            *_made("region of validity", lambda: check_region(found, basis.region)),
        )

    def _overfit(self, found: SimulatedBlocks) -> tuple[Check, ...]:
        """Check for overfitting; () for an older ledger."""
        errors = findings_of(self.run.store, self.best, bounded=False)
        if not errors:
            return ()
        train = [float(np.mean(f.train_errors)) for f in errors]
        held = [float(np.mean(f.errors)) for f in errors]
        named = identified(self.run)
        apart = () if named is None else named.disagreeing
        return (check_overfit(train, held, found, apart),)

    def on(self, records: Sequence[Trajectory]) -> tuple[Check, ...]:
        """The dossier on new records."""
        blocks = whole(records, self.problem.protocol)
        if not blocks:
            raise UserError(
                f"record '{records[0].name}' is too short: it holds no case to simulate"
            )
        y_hat = self._simulator(final_members(self.run.view, self.use))(blocks)
        pairs = list(zip(blocks, y_hat, strict=True))
        found = self._simulations(
            tuple(SimulatedBlock(b.case.u, b.y, y, b.record, b.start) for b, y in pairs)
        )
        windows = self.evaluator.horizon is not None
        basis = band_basis(self.evaluator, self.run.view, self.run.store, self.use)
        return (
            *self._of_residuals(found),
            *(_made("steps ahead", lambda: self._of_windows(pairs)) if windows else ()),
            *_made("region of validity", lambda: check_region(found, basis.region)),
            *_made("output bands", lambda: self._bands(basis, blocks, y_hat)),
        )

    def _bands(self, basis: BandBasis, blocks: Sequence[Block], y_hat: Sequence[Array]) -> Check:
        """Check the coverage of a new record by the output bands."""
        behind = models_behind(self.run.view, self.use)
        self.progress("output bands")
        try:
            each = simulate_members(self.evaluator, self.run, behind, blocks)
        except CandidateError:
            return no_bands("a fold model does not simulate this record")
        held, known = 0.0, 0
        for block, folds, mean in zip(blocks, each, y_hat, strict=True):
            bands, _ = basis.around(block.case, folds, mean, BAND_LEVEL)
            inside = (bands.lower <= block.y) & (block.y <= bands.upper)
            held, known = held + inside.sum(axis=0), known + (~np.isnan(block.y)).sum(axis=0)
        outputs = [s.name for s in self.problem.outputs]
        return check_bands(held / np.maximum(known, 1), outputs, BAND_LEVEL)

    def _simulations(self, blocks: tuple[SimulatedBlock, ...]) -> SimulatedBlocks:
        inputs = tuple(s.name for s in self.problem.inputs)
        outputs = tuple(s.name for s in self.problem.outputs)
        return SimulatedBlocks(blocks, inputs, outputs, self.problem.sampling_time)

    def _of_residuals(self, found: SimulatedBlocks) -> tuple[Check, ...]:
        """Return the checks of the registry."""
        simulator = self._simulator(final_members(self.run.view, self.use))
        given = self._range
        self.progress("responses to small steps")
        failed: list[str] = []
        linear: tuple[LinearResponse, ...] = ()
        with diagnostic("small steps", failed):
            linear = linear_responses(given, found.inputs, simulator)

        def noise() -> list[float | None]:
            return [None if r is None else r.levels.noise for r in responses(self.problem)]

        y = np.concatenate([r.y for r in self.evaluator.records])
        data = ValidationData(
            simulations=found,
            linear_responses=linear,
            lowest=y.min(axis=0),
            highest=y.max(axis=0),
            noise=noise,
            long_run=lambda: long_run(given, self.evaluator.horizon, simulator),
        )
        checks = [Check("small steps", Verdict.ABSENT, line) for line in failed]
        for name, check in validation_checks().items():
            self.progress(name)
            checks += _made(name, partial(check, data))
        return tuple(checks)

    @property
    def _range(self) -> ProbeRange:
        rule = self.problem.protocol
        return ProbeRange(self.evaluator.records, rule.past_inputs, rule.past_outputs)

    def _of_windows(self, pairs: Sequence[tuple[Block, Array]]) -> Check:
        """Check windows, each of which starts anew."""
        past = self.problem.protocol.past_outputs
        hold = np.stack([filled(b.y - b.case.past_y[-1]) for b, _ in pairs]) if past else None
        errors = np.stack([filled(b.y - y_hat) for b, y_hat in pairs])
        return check_ahead(errors, hold, self.evaluator.scale)

    def _ahead(self) -> Check:
        """Each fold's model from starts within what it did not fit."""
        if self.problem.protocol.past_outputs == 0:
            return no_steps_ahead("the protocol has no past outputs from which a model could start")
        self.progress("steps ahead, from many starts")
        member = final_members(self.run.view, "ensemble")[0]
        model_errors: list[Array] = []
        hold_errors: list[Array] = []
        for fold, name in zip(self.evaluator.folds, member.models, strict=True):
            blocks = starts(self._range, fold.validation)
            if not blocks:
                continue
            one = FinalMember(member.source, (name,))
            try:
                replies = self._simulator([one])(blocks)
            except CandidateError:
                continue
            for block, reply in zip(blocks, replies, strict=True):
                model_errors.append(filled(block.y - reply))
                hold_errors.append(filled(block.y - block.case.past_y[-1]))
        if not model_errors:
            return no_steps_ahead(
                "no held-out part is long enough for a start, or no simulation was finite"
            )
        scale = self.evaluator.scale
        return check_ahead(np.stack(model_errors), np.stack(hold_errors), scale)

    def _simulator(self, members: Sequence[FinalMember]) -> Simulator:
        """Simulations by a final model, in the sandbox."""

        def simulate(blocks: Sequence[Block]) -> list[Array]:
            total = [np.zeros_like(block.y) for block in blocks]
            for member in members:
                models = [self.run.store.get(one) for one in member.models]
                source = self.run.store.text(member.source)
                for replies in self.evaluator.simulate(source, models, blocks):
                    for sum_, reply in zip(total, replies, strict=True):
                        sum_ += member.weight / len(models) * reply
            return total

        return simulate
