"""Tools of a workspace: local fits, scores, tables, pictures."""

from __future__ import annotations

import argparse
import ast
import itertools
import linecache
import os
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from types import ModuleType
from typing import Any, NoReturn, TypeAlias

import numpy as np

from asia._files import read_text
from asia._text import say, suggestion
from asia.agents.library.pages import config_of, method_of, options_of
from asia.candidate import (
    VALIDATION_SCORES,
    Context,
    Model,
    StepModel,
    check_source,
    executed_source,
    simulate_steps,
    source_tree,
)
from asia.data.segment import Segment, SimulatedSegment
from asia.data.standardise import standardised
from asia.data.trajectory import Array
from asia.errors import CandidateError, Reason, UserError
from asia.interfaces.workspace.workspace import SCORED, scored_locally
from asia.judge.evaluation.error_analysis import (
    error_parts,
    halved_step,
    missing_terms,
    modes,
    steps_ahead,
)
from asia.judge.evaluation.fold_fits import FoldFit, derive_seed, search_context
from asia.judge.evaluation.requests import simulate_held_out, simulate_training
from asia.judge.evaluation.validation_score import rounded_score
from asia.judge.sandbox.layers.environment import COMPILED_ONCE, REPEATABLE
from asia.judge.sandbox.worker.prefixes import by_prefixes
from asia.judge.scoring.outcome import FoldRecord, check_reply, combine, score_fold
from asia.judge.scoring.residuals import (
    Diagnostics,
    Evidence,
    SignedResidual,
    signed_residuals,
    with_input,
    with_own_past,
)
from asia.ledger.simulated import SimulatedCases, simulated_cases
from asia.presentation.evidence import minima_lines
from asia.problem.check import level_lines
from asia.problem.folds import Fold, make_folds, whole
from asia.problem.load import load_problem
from asia.problem.metrics import find_metric
from asia.problem.problem import Problem
from asia.problem.protocol import FoldRule, Group, ProtocolRule
from asia.recipe import MODELS
from asia.report.files import draw_cases
from asia.search.agent_views import digest

# A candidate fitted and scored in this process, by the evaluator's own folds, order of cases and
# metric.


Fitted: TypeAlias = tuple[FoldRecord, FoldFit[Model]]
"""Record of a fold, its `diagnostics` the training error alone, and the model with its
simulations."""


def evaluate(
    source: str, folds: Sequence[Fold], context: Context, rule: ProtocolRule, fit_seconds: float
) -> tuple[Fitted, ...]:
    """Fit `source` on each fold and score it; context: that of the search, with its seed;
    fit_seconds: the limit that `context.deadline` states; a fit that takes longer is not stopped.

    Raises CandidateError for what the evaluator would refuse; what the candidate itself raises
    comes through.
    """
    check_source(source)
    source = executed_source(source)
    return tuple(_evaluate_fold(source, fold, context, rule, fit_seconds) for fold in folds)


def _evaluate_fold(
    source: str,
    fold: Fold,
    context: Context,
    rule: ProtocolRule,
    fit_seconds: float,
) -> Fitted:
    def score(blocks: Sequence[Segment], y_hat: Sequence[Array]) -> FoldRecord:
        return score_fold([b.y for b in blocks], y_hat, fold.scale, rule.metric)

    calls = 0

    def validation_score(model: Model) -> float:
        nonlocal calls
        calls += 1
        if calls > VALIDATION_SCORES:
            raise RuntimeError(f"validation_score was called {VALIDATION_SCORES} times")
        try:
            y_hat = simulate_held_out(_Simulator(model), fold.held_out)
            return rounded_score(score(fold.held_out, y_hat).value)
        except CandidateError as error:
            if error.reason is Reason.NOT_FINITE:
                return float("inf")
            raise

    # As module `candidate`, executed anew for each fold as in a worker.
    name = "candidate.py"
    module = ModuleType("candidate")
    module.__file__ = name
    sys.modules["candidate"] = module
    linecache.cache[name] = (len(source), None, source.splitlines(keepends=True), name)
    exec(compile(source, name, "exec", dont_inherit=True), module.__dict__)
    known = replace(
        context,
        seed=derive_seed(context.seed, fold.index, 0),
        deadline=time.monotonic() + fit_seconds,
        validation_score=validation_score if rule.early_stopping == "validation" else None,
    )
    train, known, restored = standardised(list(fold.train), known)
    begin = time.monotonic()
    model = restored(module.fit(train, known))
    seconds = time.monotonic() - begin
    simulator, training = _Simulator(model), whole(fold.train, rule)
    y_hat = simulate_held_out(simulator, fold.held_out)
    training_y_hat = simulate_training(simulator.simulate_known, training, rule.horizon)
    fit = FoldFit(
        model=model,
        curve=np.zeros((0, 2)),
        printed="",
        seconds=seconds,
        parameters=_parameters(model),
        y_hat=y_hat,
        train_y_hat=training_y_hat,
    )
    record = replace(
        score(fold.held_out, y_hat),
        diagnostics=Diagnostics(score(training, training_y_hat).value),
        fit_seconds=seconds,
        parameters=fit.parameters,
        residuals=_residuals(training, training_y_hat, fold.scale),
        held_out_residuals=_residuals(fold.held_out, y_hat, fold.scale),
    )
    return record, fit


def _parameters(model: Model) -> tuple[tuple[str, float], ...]:
    """Names and values that the model gives, () where it has no method `parameters`."""
    named = getattr(model, "parameters", None)
    found: Any = named() if callable(named) else {}
    return tuple((str(k), float(v)) for k, v in found.items()) if isinstance(found, dict) else ()


def _residuals(
    blocks: Sequence[Segment], y_hat: Sequence[Array], scale: Array
) -> tuple[SignedResidual, ...]:
    y = [b.simulated(found).complete_y for b, found in zip(blocks, y_hat, strict=True)]
    return signed_residuals([b.u for b in blocks], y, y_hat, scale)


@dataclass(frozen=True)
class _Simulator:
    """A model that answers as a worker does: float64, of the right shape, finite."""

    model: Model

    @property
    def has_steps(self) -> bool:
        return isinstance(self.model, StepModel)

    def simulate(self, past_u: Array, past_y: Array, u: Array, secret: bytes = b"") -> Array:
        model, cases = self.model, (past_u, past_y, u)
        if isinstance(model, StepModel):
            return self._checked(simulate_steps(model, *cases), *cases)
        return by_prefixes(self.simulate_known, *cases, secret)

    def simulate_known(self, past_u: Array, past_y: Array, u: Array) -> Array:
        return self._checked(self.model.simulate(past_u, past_y, u), past_u, past_y, u)

    def _checked(self, answer: object, past_u: Array, past_y: Array, u: Array) -> Array:
        del past_u
        y = np.array(answer, dtype=np.float64)
        check_reply(y, (*u.shape[:2], past_y.shape[2]))
        return y


# The pictures of `tools.py --plot`.


def draw(
    folder: Path,
    problem: Problem,
    title: str,
    folds: Sequence[Fold],
    found: Sequence[Fitted],
    *,
    held_out: bool,
) -> tuple[str, ...]:
    """Simulation and residuals of each fold, written into `plots/`; the names of the files."""

    def some(blocks: Sequence[Segment], y_hat: Sequence[Array]) -> tuple[Any, Any]:
        """Select at most 300 windows, evenly spaced."""
        every = -(-len(blocks) // 300)
        return blocks[::every], y_hat[::every]

    cases: list[tuple[int, bool, SimulatedSegment]] = []
    for fold, (_, fit) in zip(folds, found, strict=True):
        training = some(whole(fold.train, problem.protocol), fit.train_y_hat)
        cases += simulated_cases(fold, *training, held_out=False)
        if held_out:
            cases += simulated_cases(fold, *some(fold.held_out, fit.y_hat), held_out=True)
    shown = SimulatedCases(
        title=title,
        sampling_time=problem.sampling_time,
        windows=problem.protocol.horizon is not None,
        inputs=problem.inputs,
        outputs=problem.outputs,
        cases=tuple(cases),
    )
    names: list[str] = []
    (folder / "plots").mkdir(exist_ok=True)
    for what, picture in draw_cases(shown).items():
        names.append(f"plots/tools{'' if what == 'simulation' else f'-{what}'}.png")
        (folder / names[-1]).write_bytes(picture)
    return tuple(names)


# Tables of `tools.py`: scores, parameters, residuals, correlations.


def _parts(
    problem: Problem, folds: Sequence[Fold], found: Sequence[Fitted], *, held_out: bool
) -> list[list[SimulatedSegment]]:
    """The held-out or the training part of each fold, simulated."""
    parts: list[list[SimulatedSegment]] = []
    for fold, (_, fit) in zip(folds, found, strict=True):
        blocks = fold.held_out if held_out else whole(fold.train, problem.protocol)
        y_hat = fit.y_hat if held_out else fit.train_y_hat
        parts.append([b.simulated(y) for b, y in zip(blocks, y_hat, strict=True)])
    return parts


def tables(
    problem: Problem,
    folds: Sequence[Fold],
    found: Sequence[Fitted],
    *,
    complete: bool,
    held_out: bool,
) -> Iterator[str]:
    """Lines about a candidate; complete: whether these are all folds of V; held_out: with the
    residuals of the held-out part."""
    records = [record for record, _ in found]
    heads = [_name(fold) for fold in folds]
    # V, and the errors of each fold.
    metric = find_metric(problem.protocol.metric)
    name = "V" if complete else f"{metric.v_label}, folds of your own or not all of them"
    yield f"{name} = {combine(records).value:.6f}"
    yield from minima_lines([one.diagnostics.train_error for one in records])
    limit = problem.budget.fit_seconds
    for head, one in zip(heads, records, strict=True):
        training = one.diagnostics.train_error
        late = f"  ABOVE THE LIMIT of {limit:g} s" if one.fit_seconds > limit else ""
        yield (
            f"  {head}: {one.value:.6f}, training {training:.6f} "
            f"(ratio {one.value / training:.2f}), fit {one.fit_seconds:.1f} s{late}"
        )
        if len(problem.outputs) > 1:
            errors = zip(problem.outputs, one.per_channel(metric.name), strict=True)
            text = ", ".join(
                f"{s.name} {e:.4g} {metric.unit_of(s.unit)}".rstrip() for s, e in errors
            )
            yield f"    {metric.label}: {text}"

    # The parameters by fold.
    values_of = [dict(one.parameters) for one in records]
    names = list(dict.fromkeys(name for one in values_of for name in one))
    wide = max([len("parameters") - 2, *(len(name) for name in names)])
    if names:
        columns = "".join(f"{head:>14}" for head in heads)
        yield f"{'parameters':<{wide + 2}}{columns}   spread"
    orders = {one.get("order [states]") for one in values_of}
    for name in names:
        # A fold whose model has other modes lacks some names. Between models of different orders
        # the modes of one number are not the same.
        values = [one[name] for one in values_of if name in one]
        size = float(np.mean(np.abs(values)))
        is_mode = name.startswith(("time constant ", "frequency ", "damping "))
        known = size > 0 and len(values) > 1 and not (is_mode and len(orders) > 1)
        spread = f"{np.ptp(values) / size:9.0%}" if known else "        -"
        texts = (f"{one[name]:14.6g}" if name in one else f"{'-':>14}" for one in values_of)
        yield f"  {name:<{wide}}" + "".join(texts) + spread

    # The most significant signed residuals.
    for part in (False, True) if held_out else (False,):
        where = "held-out" if part else "training"
        yield f"signed residuals, {where} part (mean ± standard error in s.d. of the output)"
        for head, one in zip(heads, records, strict=True):
            residuals = one.held_out_residuals if part else one.residuals
            listed = [r for r in residuals if r.evidence is not Evidence.NONE]
            listed.sort(key=lambda r: r.evidence is Evidence.CHANCE)
            for residual in listed[:8]:
                text = residual.words(problem.inputs, problem.outputs)
                yield f"  {head}: {text} ({residual.share:.0%} of the error)"
            if not listed:
                yield f"  {head}: no mean residual exceeds its standard error"

    # The correlations as the picture draws them: all folds together, the held-out part if shown.
    where = "held-out" if held_out else "training"
    yield f"correlation of the residuals, {where} part, all folds together, 99 % bands"
    blocks = [b for part in _parts(problem, folds, found, held_out=held_out) for b in part]
    errors = [b.residual for b in blocks]
    for k, output in enumerate(problem.outputs):
        text = _correlations(problem, blocks, [e[:, k] for e in errors])
        yield f"  {output.name}: {text}"


def _correlations(problem: Problem, blocks: Sequence[Segment], e: Sequence[Array]) -> str:
    """Describe the correlation of residuals (H,) with their own past and with the inputs."""
    own = with_own_past(e)
    within = np.flatnonzero(np.abs(own.values) < own.band)
    length = int(within[0]) if len(within) else own.lags[-1]
    longer = "" if len(within) else " or more"
    parts = [f"own past {own.values[1]:.2f} at lag 1, above the band for {length}{longer} lags"]
    for i, signal in enumerate(problem.inputs):
        found = with_input(e, [b.u[:, i] for b in blocks])
        place = int(np.argmax(np.abs(found.values)))
        largest = float(found.values[place])
        side = "above" if abs(largest) > found.band else "within"
        parts.append(
            f"{signal.name} {largest:.2f} at lag {found.lags[place]}, {side} the band of "
            f"{found.band:.2f}"
        )
    return "; ".join(parts)


def _name(fold: Fold) -> str:
    return f"fold {fold.index + 1}"


def analysis(
    problem: Problem, folds: Sequence[Fold], found: Sequence[Fitted], *, held_out: bool
) -> Iterator[str]:
    """Lines about the parts of the held-out error, the modes, and the terms that a model may lack;
    held_out: whether the terms are looked for in the residuals of the held-out part."""
    step = problem.sampling_time
    yield "parts of the held-out error (shares of the squared error)"
    training = _parts(problem, folds, found, held_out=False)
    for fold, (_, fit), parts in zip(folds, found, training, strict=True):
        error = error_parts(fit.model, fold.held_out, fit.y_hat, fold.scale, step)
        first = "not known (no states)"
        if error.initial_state is not None:
            first = f"{error.initial_state:.0%}"
        yield (
            f"  {_name(fold)}: initial state {first}, offset and drift {error.slow:.0%}, dynamics "
            f"and noise {error.dynamics:.0%}"
        )
        ahead = steps_ahead(fit.model, fold.held_out, fit.y_hat, fold.scale)
        if ahead:
            text = ", ".join(f"{e:.2g} at step {k}" for k, e in ahead.items())
            yield f"    after starts from measured samples, in s.d. of the output: {text}"
        finer = halved_step(fit.model, fold.held_out, fit.y_hat, fold.scale)
        if finer is not None:
            text = "the step is short enough"
            if finer.matters:
                text = "the step is too long: raise `substeps`, or refine the grid"
            yield (
                f"    half the step of the integration: RMS error {finer.value:.4g} becomes "
                f"{finer.half:.4g}, standard error {finer.error:.1g}: {text}"
            )
        course = " ".join(f"{e:.2g}" for e in error.over_time)
        yield f"    over the block, tenths, in s.d. of the output: {course}"
        bands = zip(error.frequencies, error.frequencies[1:], error.bands, strict=False)
        yield "    by frequency: " + ", ".join(
            f"{low:.3g} to {high:.3g} Hz {share:.0%}" for low, high, share in bands
        )
        if isinstance(fit.model, StepModel):
            texts = list(modes(fit.model, parts[0], parts[0].y_hat, step))
            if texts:
                yield f"    modes at the mean state: {'; '.join(texts[:8])}"
    yield from level_lines(problem)
    where = "held-out" if held_out else "training"
    yield (
        f"missing terms, score test on the {where} part: share of the squared residual that a term "
        "explains beyond linear ones"
    )
    blocks = _parts(problem, folds, found, held_out=held_out)
    y_hat = [[b.y_hat for b in part] for part in blocks]
    inputs, outputs = ([s.name for s in each] for each in (problem.inputs, problem.outputs))
    states = [] if problem.physics is None else list(problem.physics.states)
    ranked = missing_terms([fit.model for _, fit in found], blocks, y_hat, inputs, outputs, states)
    for k, output in enumerate(outputs):
        own = [term for term in ranked if term.output == k and term.share >= 0.01]
        for linear, most in ((False, 5), (True, 2)):
            for term in [term for term in own if term.linear is linear][:most]:
                yield (
                    f"  {output}: {term.term} {term.where} {term.share:.0%}, in {term.folds} of "
                    f"{len(folds)} folds{' (linear: order, delay or fit)' * linear}"
                )
        if not own:
            yield f"  {output}: no term explains more than chance and more than 1 %"


# Workspace of `tools.py`: the problem as the evaluator reads it, and splits of its records.


@dataclass(frozen=True)
class WorkspaceTools:
    """The tools of one workspace."""

    folder: Path
    """The workspace."""
    seed: int
    """Seed of its search."""

    @cached_property
    def problem(self) -> Problem:
        """problem.toml of the folder, with the training records of `data/`."""
        return load_problem(self.folder)

    @property
    def rule(self) -> ProtocolRule:
        """Rule by which V is computed."""
        return self.problem.protocol

    @property
    def context(self) -> Context:
        """Context of a candidate, except for the seed of its fold."""
        return search_context(self.problem, derive_seed(self.seed, "search"))

    @cached_property
    def folds(self) -> tuple[Fold, ...]:
        """Those that V is computed on."""
        return make_folds(self.problem.train, self.rule)

    def blocks(self, count: int) -> tuple[Fold, ...]:
        """Folds of your own: each record in `count` blocks, of which each is held out once."""
        return self._split(FoldRule("contiguous", count))

    def hold_out(self, names: Sequence[str]) -> tuple[Fold, ...]:
        """Return one fold of your own: these records are held out, all others train."""
        records = [t.name for t in self.problem.train]
        for name in names:
            if name not in records:
                raise UserError(
                    f"there is no record '{name}'{suggestion(name, records)} (they are "
                    f"{', '.join(records)})"
                )
        rest = tuple(name for name in records if name not in names)
        if not rest:
            raise UserError("all records are held out: leave one or more to train on")
        groups = Group("held out", tuple(names)), Group("rest", rest)
        return self._split(FoldRule("leave_one_group_out", 2, groups))[:1]

    def evaluate(
        self, path: Path | str = "candidate.py", folds: Sequence[Fold] | None = None
    ) -> tuple[Fitted, ...]:
        """The candidate in that file, fitted and scored on these folds; None for those of V."""
        source = read_text(self.folder / path, "name a candidate, as Python source")
        return self.evaluate_source(source, folds)

    def evaluate_source(
        self, source: str, folds: Sequence[Fold] | None = None
    ) -> tuple[Fitted, ...]:
        """The candidate, fitted and scored on these folds; None for those of V."""
        chosen = self.folds if folds is None else folds
        limit = self.problem.budget.fit_seconds
        found = evaluate(source, chosen, self.context, self.rule, limit)
        if any(one is fold for one in chosen for fold in self.folds):
            with (self.folder / SCORED).open("a", encoding="utf-8") as file:
                file.write(f"{digest(source)}\n")
        return found

    def _split(self, folds: FoldRule) -> tuple[Fold, ...]:
        return make_folds(self.problem.train, replace(self.rule, folds=folds))


def variants(source: str, settings: Sequence[str]) -> Iterator[tuple[str, str]]:
    """Yield each combination of values of settings, and the candidate with them.

    Args:
        settings: `order=1,2,3`, each the name of one keyword argument in the source and its values

    A setting that the source does not write is added to the one call that takes it, of a `Config`
    or of a training method of the library.

    Raises:
        UserError: for a setting that is in the source several times, or that no call takes
    """
    # Where a value goes, what comes before it, and its choices.
    places: list[tuple[int, int]] = []
    choices: list[list[tuple[str, str, str]]] = []
    lines = np.cumsum([0, *(len(line) for line in source.encode().splitlines(keepends=True))])
    calls = [node for node in ast.walk(source_tree(source)) if isinstance(node, ast.Call)]
    for text in settings:
        name, _, values = text.partition("=")
        found = [key.value for node in calls for key in node.keywords if key.arg == name]
        takers = [node for node in calls if not found and name in _options(node)]
        if len(found) + len(takers) != 1 or not values:
            raise UserError(
                f"--vary {text}: expected NAME=VALUE,VALUE with a setting that the candidate "
                f"writes once, or that one call of Config or a training method takes; '{name}' is "
                f"written {len(found)} times, and {len(takers)} calls take it: write {name}=VALUE "
                "once"
            )
        (node,) = (*found, *takers)
        assert node.end_lineno is not None and node.end_col_offset is not None  # noqa: PT018
        begin = int(lines[node.lineno - 1]) + node.col_offset
        end = int(lines[node.end_lineno - 1]) + node.end_col_offset
        before = ""
        if isinstance(node, ast.Call) and takers:
            # Before the closing parenthesis, and after a last comma.
            end = begin = end - 1
            is_first = (begin, end) not in places
            is_first &= source.encode()[:end].rstrip().endswith((b"(", b","))
            before = f"{'' if is_first else ', '}{name}="
        places.append((begin, end))
        choices.append([(name, word, before) for word in map(_literal, values.split(","))])
    for combination in itertools.product(*choices):
        changed = source.encode()
        edits = zip(places, range(len(places)), combination, strict=True)
        for (begin, end), _, (_, word, before) in sorted(edits, reverse=True):
            changed = changed[:begin] + f"{before}{word}".encode() + changed[end:]
        yield ", ".join(f"{name}={word}" for name, word, _ in combination), changed.decode()


def _options(call: ast.Call) -> tuple[str, ...]:
    """Names of the options of a call such as `greybox.Config()` or `LevenbergMarquardt()`; () for
    any other call."""
    words = ast.unparse(call.func).split(".")
    try:
        settings = config_of(MODELS, words[-2]) if words[-1] == "Config" else method_of(words[-1])
        return tuple(option.name for option in options_of(settings))
    except (ImportError, AttributeError, IndexError, ValueError):
        return ()


def _literal(word: str) -> str:
    try:
        return repr(ast.literal_eval(word))
    except (ValueError, SyntaxError):
        return repr(word)


# `python tools.py`: what it takes, and what it prints.


def main(tools: WorkspaceTools) -> NoReturn:
    """Read the command line, fit and score, print. The process starts itself again where its
    environment is not that of a worker."""
    parser = argparse.ArgumentParser(
        prog="tools.py", description="Score a candidate on training folds, as the evaluator does."
    )
    add = parser.add_argument
    add(
        "candidates",
        nargs="*",
        default=["candidate.py"],
        metavar="FILE",
        help="files to score, default candidate.py; several print one row each",
    )
    add("--seed", type=int, help="seeds of the fits; several show the spread of V")
    add("--fold", type=int, help="this fold alone, from 1")
    add("--blocks", type=int, help="folds of your own: number of parts of each record")
    add("--hold-out", metavar="NAMES", help="a fold of your own: hold these records out (A,B)")
    add(
        "--vary",
        action="append",
        metavar="NAME=VALUES",
        help="values of a setting of Config or of the training method, one row each: order=2,3; a "
        "setting that the candidate leaves out is added to the call that takes it",
    )
    add("--why", action="store_true", help="parts of the error, modes, missing terms")
    add("--plot", action="store_true", help="draw simulation and residuals into plots/")
    options = parser.parse_args()
    if any(os.environ.get(name) != value for name, value in REPEATABLE.items()):
        sys.stdout.flush()
        # Compiled programs stay in the folder for the next start.
        cache = {"JAX_COMPILATION_CACHE_DIR": str(tools.folder / ".asia" / "programs")}
        settings = {**os.environ, **REPEATABLE, **COMPILED_ONCE, **cache}
        os.execve(sys.executable, sys.orig_argv, settings)
    try:
        _run(tools, options)
        sys.stdout.flush()
    except BrokenPipeError:
        # The reader, such as `head`, has ended: nothing more is written.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except (UserError, CandidateError) as error:
        text = str(error)
        if isinstance(error, CandidateError):
            text = f"{error.reason.advice} ({error.detail})"
        say(f"tools.py: {text}", file=sys.stderr)
        sys.exit(2)
    sys.exit(0)


def _run(tools: WorkspaceTools, options: argparse.Namespace) -> None:
    if options.seed is not None:
        tools = replace(tools, seed=options.seed)
    own = options.blocks is not None or options.hold_out is not None
    if options.blocks is not None:
        folds = tools.blocks(options.blocks)
    elif options.hold_out is not None:
        folds = tools.hold_out(options.hold_out.split(","))
    else:
        folds = tools.folds
    if options.fold is not None:
        if not 1 <= options.fold <= len(folds):
            raise UserError(f"there is no fold {options.fold}: expected 1 to {len(folds)}")
        folds = folds[options.fold - 1 : options.fold]
    if options.vary or len(options.candidates) > 1:
        if options.why or options.plot:
            raise UserError("--why and --plot are for one candidate: leave out --vary, other files")
        for path in options.candidates:
            source = read_text(tools.folder / path, "name a candidate, as Python source")
            for name, changed in variants(source, options.vary or ()):
                label = " ".join((path,) * (len(options.candidates) > 1) + (name,) * bool(name))
                try:
                    tried = tools.evaluate_source(changed, folds)
                except CandidateError as error:
                    say(f"no V       {label}: {error.reason.advice}", flush=True)
                    continue
                for line in _row(label, tried):
                    say(line, flush=True)
        if not own and scored_locally(tools.folder) > 1:
            say(_scored(tools))
        return
    (candidate,) = options.candidates
    found = tools.evaluate(candidate, folds)
    complete = not own and len(found) == len(tools.folds)
    held_out = tools.rule.residuals == "held_out"
    for line in tables(tools.problem, folds, found, complete=complete, held_out=held_out):
        say(line)
    if not own and scored_locally(tools.folder) > 1:
        say(_scored(tools))
    if options.why:
        for line in analysis(tools.problem, folds, found, held_out=held_out):
            say(line)
    if options.plot:
        for name in draw(tools.folder, tools.problem, candidate, folds, found, held_out=held_out):
            say(f"picture {name}")


_MOST_PARAMETERS = 8


def _row(label: str, found: Sequence[Fitted]) -> Iterator[str]:
    """V of one of several candidates, and the means of its first parameters over the folds."""
    records = [record for record, _ in found]
    each = ", ".join(f"{one.value:.4f}" for one in records)
    training = ", ".join(f"{one.diagnostics.train_error:.4f}" for one in records)
    seconds = sum(one.fit_seconds for one in records)
    yield (
        f"V {combine(records).value:.6f} {label} (folds {each}; training {training}; fit "
        f"{seconds:.1f} s)"
    )
    tables = [dict(one.parameters) for one in records]
    names = [name for name in tables[0] if all(name in table for table in tables)]
    if names:
        means = (f"{n} {np.mean([t[n] for t in tables]):.4g}" for n in names[:_MOST_PARAMETERS])
        more = f", {len(names) - _MOST_PARAMETERS} more" if len(names) > _MOST_PARAMETERS else ""
        yield f"    parameters, mean of the folds: {', '.join(means)}{more}"


def _scored(tools: WorkspaceTools) -> str:
    many = scored_locally(tools.folder)
    return (
        f"scored here on the folds of V so far: {many} candidates. The lowest V of many is "
        "optimistic: --blocks N has folds of your own"
    )
