"""Ablation: the best candidate with parts taken back, and the source of its gain."""

import ast
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from asia.analysis.confirmation import check_repeatable
from asia.candidate import source_digest, source_tree
from asia.data.trajectory import Array
from asia.errors import CandidateError, UserError
from asia.judge.evaluation.evaluator import Evaluator
from asia.judge.sandbox.types import Isolation
from asia.judge.scoring.outcome import Failure
from asia.judge.scoring.repeated_fits import Attribution, attribute, gain
from asia.ledger.artifacts import Store
from asia.ledger.chain import Chain
from asia.ledger.events import Ablated, Fit, LeftOut
from asia.ledger.view import Experiment
from asia.problem.load import load_lock
from asia.recipe import Arguments, Recipe, read_recipe
from asia.search.run import LOCK, make_evaluator

# Candidates in the standard layout, taken apart into model and training and put together anew.


_FIT = ast.dump(ast.parse("return train(build_model(context), trajectories, context)").body[0])
_LAYOUT = (
    "the standard layout has build_model(context), train(model, trajectories, context), and fit "
    "that returns train(build_model(context), trajectories, context)"
)


def crossed(model: str, training: str) -> str:
    """A candidate with the model of one source and the training of another. Raises UserError where
    they cannot be split, or define a name that both need differently."""
    build, train = _needed(model, "build_model"), _needed(training, "train")
    known = {ast.dump(one) for one in build}
    taken = {name for one in build for name in _defined(one)}
    added = [one for one in train if ast.dump(one) not in known]
    both = sorted({n for one in added for n in _defined(one)} & taken)
    if both:
        raise UserError(f"both candidates define {', '.join(both)}, and not the same")
    fit = ast.parse(
        "def fit(trajectories, context):\n"
        "    return train(build_model(context), trajectories, context)\n"
    )
    return _unparsed([*_imports_first((*build, *added)), *fit.body])


def _needed(source: str, name: str) -> list[ast.stmt]:
    """The statements of a candidate that define `name`, and all that they use. Raises UserError for
    another layout."""
    tree = _tree(source)
    functions = {one.name: one for one in tree.body if isinstance(one, ast.FunctionDef)}
    missing = [each for each in ("build_model", "train", "fit") if each not in functions]
    if missing:
        raise UserError(f"a candidate has no function {missing[0]}: {_LAYOUT}")
    body = [one for one in functions["fit"].body if not _is_docstring(one)]
    if len(body) != 1 or ast.dump(body[0]) != _FIT:
        raise UserError(f"fit of a candidate contains further code: {_LAYOUT}")
    statements = [one for one in tree.body if not _is_docstring(one)]
    expected, found = {name}, set[int]()
    while True:
        more = {
            i
            for i, one in enumerate(statements)
            if i not in found and expected.intersection(_defined(one))
        }
        if not more:
            return [statements[i] for i in sorted(found)]
        found |= more
        nodes = (node for i in more for node in ast.walk(statements[i]))
        expected |= {node.id for node in nodes if isinstance(node, ast.Name)}


def without_change(best: str, before: str, after: str) -> str | None:
    """The best candidate without what changed from `before` to `after`, two candidates of its
    lineage; None where nothing of that change is left in it. Raises UserError where it cannot be
    taken back alone."""
    whole, old, new = (read_recipe(source) for source in (best, before, after))
    if whole is None or old is None or new is None:
        found = _statements_without(best, before, after)
    else:
        found = _recipe_without(whole, old, new).source("")
    return None if source_digest(found) == source_digest(best) else found


def _recipe_without(best: Recipe, before: Recipe, after: Recipe) -> Recipe:
    if (before.package, before.family) != (after.package, after.family):
        raise UserError("it changes the family: see model and training crossed")
    taken = replace(best, config=_settings_without(best.config, before.config, after.config))
    if before.method == after.method:
        options = _settings_without(best.options, before.options, after.options)
        return replace(taken, options=options)
    if best.method == after.method:
        return replace(taken, method=before.method, options=before.options)
    return taken


def _settings_without(best: Arguments, before: Arguments, after: Arguments) -> Arguments:
    """A setting is taken back where the best candidate still has the value that the change gave
    it."""
    settings, old, new = dict(best), dict(before), dict(after)
    for name in dict.fromkeys([*old, *new]):
        was, became, now = ((name in s, s.get(name)) for s in (old, new, settings))
        if was == became or now != became:
            continue
        if name in old:
            settings[name] = old[name]
        else:
            del settings[name]
    return tuple(settings.items())


def _statements_without(best: str, before: str, after: str) -> str:
    """Whole top-level statements are taken back: a function, a class, a constant."""
    old, new, whole = (
        {name: one for one in _tree(source).body for name in _defined(one)}
        for source in (before, after, best)
    )

    def text(statements: dict[str, ast.stmt], name: str) -> str:
        return ast.dump(statements[name]) if name in statements else ""

    for name in dict.fromkeys([*old, *new]):
        if text(old, name) == text(new, name):
            continue
        if text(whole, name) != text(new, name):
            raise UserError(f"a later change of {name} builds on it")
        if name in old:
            whole[name] = old[name]
        else:
            del whole[name]
    # A statement may define several names.
    statements = {id(one): one for one in whole.values()}
    return _unparsed(_imports_first(statements.values()))


def _unparsed(statements: list[ast.stmt]) -> str:
    return ast.unparse(ast.fix_missing_locations(ast.Module(statements, []))) + "\n"


def _tree(source: str) -> ast.Module:
    try:
        return source_tree(source)
    except CandidateError as error:
        raise UserError(f"a candidate cannot be parsed: {error.detail}") from None


def _is_docstring(one: ast.stmt) -> bool:
    return isinstance(one, ast.Expr) and isinstance(one.value, ast.Constant)


def _defined(one: ast.stmt) -> Iterator[str]:
    """The names that a top-level statement binds."""
    if isinstance(one, ast.FunctionDef | ast.ClassDef | ast.AsyncFunctionDef):
        yield one.name
    elif isinstance(one, ast.Import | ast.ImportFrom):
        yield from (alias.asname or alias.name.split(".")[0] for alias in one.names)
    else:
        nodes = ast.walk(one)
        yield from (n.id for n in nodes if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store))


def _imports_first(statements: Iterable[ast.stmt]) -> list[ast.stmt]:
    """Sort `from __future__` imports first, then imports before their uses."""

    def place(one: ast.stmt) -> int:
        if isinstance(one, ast.ImportFrom) and one.module == "__future__":
            return 0
        return 1 if isinstance(one, ast.Import | ast.ImportFrom) else 2

    return sorted(statements, key=place)


# Fit the best candidate of a finished search with parts taken back, and say what its gain is due
# to.
#
# It reads training records alone.


OnFit = Callable[[Fit, int, int], None]

# The ledger keeps these names.
_BEST = "the best candidate"
_BASELINE = "the baseline"
_MODEL = "the best candidate's model with the baseline's training"
_TRAINING = "the baseline's model with the best candidate's training"


@dataclass(frozen=True)
class Variant:
    """A candidate to be fitted for an ablation."""

    name: str
    source: str

    @property
    def digest(self) -> str:
        """Digest of the normalised AST: equivalent variants are fitted once."""
        return source_digest(self.source)


def ablate(
    directory: Path, on_fit: OnFit, *, seeds: int = 3, isolation: Isolation | None = None
) -> tuple[Ablated, bool]:
    """Cross model and training of best candidate and baseline, and leave each change of the best
    candidate's lineage out; True where the ledger had no such result yet.

    Each fit is an event of the ledger: one that is there is not repeated, whether the command was
    killed or asks for more seeds now. on_fit: called after each fit with its event, the number of
    fits that are done, and that of all there may be. isolation: level of the candidates; None for
    the strongest of this machine.

    Raises UserError when the search is not finished, its best candidate is its baseline, or it came
    without its artifacts.
    """
    with Chain(directory / "ledger.jsonl") as chain:
        view = chain.view
        check_repeatable(directory, view, "an ablation")
        best = view.best
        assert best is not None
        if best.number == 1:
            raise UserError(
                f"the best candidate of run '{view.started.run}' is its baseline: there is no "
                "gain to attribute"
            )
        problem = load_lock(directory / LOCK)
        evaluator = make_evaluator(problem, view, isolation=isolation)
        store = Store(directory / "artifacts")
        found = _Ablation(chain, store, evaluator, seeds, on_fit).run(best)
        if view.ablated == found:
            return found, False
        chain.append(found)
        return found, True


@dataclass(frozen=True)
class _Ablation:
    """An ablation under way."""

    chain: Chain
    store: Store
    evaluator: Evaluator
    seeds: int
    on_fit: OnFit

    def run(self, best: Experiment) -> Ablated:
        """Fit all variants and summarise them."""
        view = self.chain.view
        baseline = view.experiment(1)
        whole, first = self._source(best), self._source(baseline)
        variants = [Variant(_BEST, whole)]
        # Model and training of the two crossed, or why they cannot be.
        reason = "" if baseline.score is not None else "the baseline has no score"
        if not reason:
            try:
                sources = first, crossed(whole, first), crossed(first, whole)
                variants += map(Variant, (_BASELINE, _MODEL, _TRAINING), sources)
            except UserError as error:
                reason = str(error)
        has_crossing = not reason
        # The best candidate without each change of its lineage, or why there is no such variant.
        changes: dict[int, Variant | str] = {}
        for before, after in pairwise(view.lineage):
            number = after.number
            try:
                source = without_change(whole, self._source(before), self._source(after))
            except UserError as error:
                changes[number] = str(error)
                continue
            name = f"the best candidate without the change of #{number:02d}"
            changes[number] = Variant(name, source) if source else "no part of it is left"
        variants += [v for v in changes.values() if isinstance(v, Variant)]
        values = self._fit_all(variants)
        crossing: Attribution | None = None
        if has_crossing:
            names = (_BASELINE, _MODEL, _TRAINING, _BEST)
            failed = [name for name in names if not len(values[name])]
            if failed:
                reason = f"{failed[0]} fails with every seed"
            else:
                crossing = attribute(*(values[name] for name in names))
        left_out: list[LeftOut] = []
        for number, made in sorted(changes.items()):
            if isinstance(made, str):
                left_out.append(LeftOut(number, detail=made))
            elif not len(values[made.name]) or not len(values[_BEST]):
                left_out.append(LeftOut(number, detail="it fails with every seed"))
            else:
                left_out.append(LeftOut(number, gain(values[made.name], values[_BEST])))
        return Ablated(best.number, baseline.number, self.seeds, crossing, reason, tuple(left_out))

    def _source(self, experiment: Experiment) -> str:
        return self.store.text(experiment.source)

    def _fit_all(self, variants: list[Variant]) -> dict[str, Array]:
        """V of each over the seeds, a single value where fits do not depend on them."""
        view = self.chain.view
        known = {(fit.digest, fit.seed): fit for fit in view.fits if fit.purpose == "ablation"}
        in_search = {
            (e.proposed.digest, tuple(fold.value for fold in e.score.folds))
            for e in view.finished
            if e.score
        }
        different = {variant.digest: variant for variant in variants}
        total, done = len(different) * self.seeds, 0
        with self.evaluator.workers.ready_workers():
            for digest, variant in different.items():
                before: Fit | None = None
                for repeat in range(1, self.seeds + 1):
                    done += 1
                    fit = known.get((digest, repeat))
                    if fit is None:
                        fit = known[digest, repeat] = self._fit(variant, repeat)
                        self.chain.append(fit)
                        self.on_fit(fit, done, total)
                    # The seed has no effect: V of all folds is as before, or as in the search.
                    if before is None:
                        same = (digest, fit.folds) in in_search
                    else:
                        same = bool(fit.folds) and fit.folds == before.folds
                    if same:
                        done += self.seeds - repeat
                        break
                    before = fit
        values: dict[str, Array] = {}
        for variant in variants:
            fits = [known.get((variant.digest, repeat)) for repeat in range(1, self.seeds + 1)]
            found = [fit for fit in fits if fit is not None and fit.value is not None]
            alike = len({fit.folds for fit in found}) == 1
            values[variant.name] = np.array([fit.value for fit in found[: 1 if alike else None]])
        return values

    def _fit(self, variant: Variant, repeat: int) -> Fit:
        begin = time.monotonic()
        outcome = self.evaluator.evaluate(variant.source, repeat).outcome
        seconds = time.monotonic() - begin
        source = self.store.put(variant.source.encode())
        fit = Fit(
            repeat, "ablation", variant=variant.name, source=source, digest=variant.digest,
            seconds=seconds,
        )  # fmt: skip
        if isinstance(outcome, Failure):
            return replace(fit, failed=outcome.reason.value)
        folds = tuple(fold.value for fold in outcome.folds)
        return replace(fit, value=outcome.value, folds=folds)
