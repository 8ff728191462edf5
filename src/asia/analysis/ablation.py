"""Ablation: the winner with parts taken back, and the source of its gain."""

from __future__ import annotations

import ast
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from asia._syntax import syntax_tree
from asia.agents.library.recipe import Arguments, Recipe, read_recipe
from asia.analysis.confirmation import check_repeatable
from asia.candidate import source_digest
from asia.data.trajectory import Array
from asia.errors import UserError
from asia.judge.evaluation.evaluator import Evaluator
from asia.judge.scoring.confirmation import Attribution, attribute, gain
from asia.judge.scoring.outcome import Failure
from asia.ledger.artifacts import Store
from asia.ledger.chain import Chain
from asia.ledger.events import Ablated, AblationFit, LeftOut
from asia.ledger.view import Experiment, SearchView
from asia.problem.load import load_lock
from asia.search.run import LOCK, make_evaluator

# Candidates in the standard layout, taken apart into model and training and put together anew.


_FIT = ast.dump(ast.parse("return train(build_model(context), trajectories, context)").body[0])
_LAYOUT = (
    "the standard layout has build_model(context), train(model, trajectories, context), and fit "
    "that returns train(build_model(context), trajectories, context)"
)


@dataclass(frozen=True)
class _Parts:
    """The statements of a candidate by the names that they define."""

    order: tuple[ast.stmt, ...]
    """Statements that do not define one name, in their order."""

    def needed(self, name: str) -> list[ast.stmt]:
        """The statements that define `name`, and all that they use."""
        expected, found = {name}, set[int]()
        while True:
            more = {
                i
                for i, one in enumerate(self.order)
                if i not in found and expected.intersection(_defined(one))
            }
            if not more:
                return [self.order[i] for i in sorted(found)]
            found |= more
            expected |= {used for i in more for used in _used(self.order[i])}


def crossed(model: str, training: str) -> str:
    """A candidate with the model of one source and the training of another. Raises UserError where
    they cannot be split, or define a name that both need differently."""
    build, train = _parts(model).needed("build_model"), _parts(training).needed("train")
    known = {ast.dump(one) for one in build}
    taken = {name for one in build for name in _defined(one)}
    added = [one for one in train if ast.dump(one) not in known]
    both = sorted({n for one in added for n in _defined(one)} & taken)
    if both:
        raise UserError(f"both candidates define {', '.join(both)}, and not the same")
    tree = ast.Module([*_futures_first((*build, *added)), _fit_function()], [])
    return ast.unparse(ast.fix_missing_locations(tree)) + "\n"


def without_change(winner: str, before: str, after: str) -> str | None:
    """The winner without what changed from `before` to `after`, two candidates of its lineage; None
    where nothing of that change is left in it. Raises UserError where it cannot be taken back
    alone."""
    recipes = [read_recipe(source) for source in (winner, before, after)]
    if all(one is not None for one in recipes):
        whole, old, new = (one for one in recipes if one is not None)
        found = _recipe_without(whole, old, new).source("")
    else:
        found = _statements_without(winner, before, after)
    return None if source_digest(found) == source_digest(winner) else found


def _recipe_without(winner: Recipe, before: Recipe, after: Recipe) -> Recipe:
    if (before.package, before.family) != (after.package, after.family):
        raise UserError("it changes the family: see model and training crossed")
    taken = replace(winner, config=_settings_without(winner.config, before.config, after.config))
    if before.method != after.method:
        if winner.method != after.method:
            return taken
        return replace(taken, method=before.method, options=before.options)
    options = _settings_without(winner.options, before.options, after.options)
    return replace(taken, options=options)


def _settings_without(winner: Arguments, before: Arguments, after: Arguments) -> Arguments:
    """A setting is taken back where the winner still has the value that the change gave it."""
    settings, old, new = dict(winner), dict(before), dict(after)
    for name in dict.fromkeys([*old, *new]):
        if old.get(name) == new.get(name) and (name in old) == (name in new):
            continue
        if settings.get(name) != new.get(name) or (name in settings) != (name in new):
            continue
        if name in old:
            settings[name] = old[name]
        else:
            del settings[name]
    return tuple(settings.items())


def _statements_without(winner: str, before: str, after: str) -> str:
    """Whole top-level statements are taken back: a function, a class, a constant."""
    old, new, whole = (_by_name(_tree(source)) for source in (before, after, winner))
    changed = [n for n in dict.fromkeys([*old, *new]) if _text(old, n) != _text(new, n)]
    for name in changed:
        if _text(whole, name) != _text(new, name):
            raise UserError(f"a later change of {name} builds on it")
        if name in old:
            whole[name] = old[name]
        else:
            del whole[name]
    tree = ast.Module(list(_futures_first(_unique(whole.values()))), [])
    return ast.unparse(ast.fix_missing_locations(tree)) + "\n"


def _text(statements: dict[str, ast.stmt], name: str) -> str:
    return ast.dump(statements[name]) if name in statements else ""


def _by_name(tree: ast.Module) -> dict[str, ast.stmt]:
    return {name: one for one in tree.body for name in _defined(one)}


def _unique(statements: Iterable[ast.stmt]) -> list[ast.stmt]:
    return list({id(one): one for one in statements}.values())


def _parts(source: str) -> _Parts:
    """Raises UserError for another layout."""
    tree = _tree(source)
    functions = {one.name: one for one in tree.body if isinstance(one, ast.FunctionDef)}
    missing = [name for name in ("build_model", "train", "fit") if name not in functions]
    if missing:
        raise UserError(f"a candidate has no function {missing[0]}: {_LAYOUT}")
    body = [one for one in functions["fit"].body if not _is_docstring(one)]
    if len(body) != 1 or ast.dump(body[0]) != _FIT:
        raise UserError(f"fit of a candidate contains further code: {_LAYOUT}")
    return _Parts(tuple(one for one in tree.body if not _is_docstring(one)))


def _tree(source: str) -> ast.Module:
    try:
        return syntax_tree(source, "candidate.py")
    except (SyntaxError, ValueError) as error:
        raise UserError(f"a candidate cannot be parsed: {error}") from None


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


def _used(one: ast.stmt) -> set[str]:
    return {node.id for node in ast.walk(one) if isinstance(node, ast.Name)}


def _futures_first(statements: Iterable[ast.stmt]) -> list[ast.stmt]:
    """Sort `from __future__` imports first, then imports before their uses."""
    every = list(statements)
    imports = [one for one in every if isinstance(one, ast.Import | ast.ImportFrom)]
    futures = [one for one in imports if _is_future(one)]
    rest = [one for one in every if not isinstance(one, ast.Import | ast.ImportFrom)]
    return [*futures, *(one for one in imports if not _is_future(one)), *rest]


def _is_future(one: ast.stmt) -> bool:
    return isinstance(one, ast.ImportFrom) and one.module == "__future__"


def _fit_function() -> ast.stmt:
    lines = (
        "def fit(trajectories, context):\n"
        "    return train(build_model(context), trajectories, context)\n"
    )
    return ast.parse(lines).body[0]


# Fit the winner of a finished search with parts taken back, and say what its gain is due to.
#
# It reads training records alone.


OnFit = Callable[[AblationFit, int, int], None]

_WINNER = "the winner"
_BASELINE = "the baseline"
_MODEL = "the winner's model with the baseline's training"
_TRAINING = "the baseline's model with the winner's training"


@dataclass(frozen=True)
class Variant:
    """A candidate to be fitted for an ablation."""

    name: str
    """Description of the variant."""
    source: str
    """Its `candidate.py`."""

    @property
    def digest(self) -> str:
        """Digest of the normalised AST: equivalent variants are fitted once."""
        return source_digest(self.source)


def ablate(directory: Path, on_fit: OnFit, *, seeds: int = 3) -> tuple[Ablated, bool]:
    """Cross model and training of winner and baseline, and leave each change of the winner's
    lineage out; True where the ledger had no such result yet.

    Each fit is an event of the ledger: one that is there is not repeated, whether the command was
    killed or asks for more seeds now. on_fit: called after each fit with its event, the number of
    fits that are done, and that of all there may be.

    Raises UserError when the search is not finished, is with ladder feedback, its winner is its
    baseline, or it came without its artifacts.
    """
    with Chain(directory / "ledger.jsonl") as chain:
        view = chain.view
        check_repeatable(directory, view, "an ablation")
        winner = view.best
        assert winner is not None
        if winner.number == 1:
            raise UserError(
                f"the winner of run '{view.started.run}' is its baseline: there is no gain to "
                "attribute"
            )
        problem = load_lock(directory / LOCK)
        evaluator = make_evaluator(problem, view)
        store = Store(directory / "artifacts")
        found = _Ablation(chain, store, evaluator, seeds, on_fit).run(winner)
        if view.ablated == found:
            return found, False
        chain.append(found)
        return found, True


def lineage(view: SearchView, winner: Experiment) -> list[Experiment]:
    """The winner and what it was made from, the oldest first."""
    found = [winner]
    while (parent := found[-1].proposed.parent) is not None and parent < found[-1].number:
        found.append(view.experiment(parent))
    return found[::-1]


@dataclass(frozen=True)
class _Ablation:
    """An ablation under way."""

    chain: Chain
    store: Store
    evaluator: Evaluator
    seeds: int
    on_fit: OnFit

    def run(self, winner: Experiment) -> Ablated:
        """Fit all variants and summarise them."""
        view = self.chain.view
        baseline = view.experiment(1)
        cross, reason = self._crossing(winner, baseline)
        changes = self._changes(winner)
        variants = {_WINNER: Variant(_WINNER, self._source(winner)), **cross}
        variants |= {v.name: v for v in changes.values() if isinstance(v, Variant)}
        values = self._fit_all(list(variants.values()))
        found: Attribution | None = None
        if cross:
            names = (_BASELINE, _MODEL, _TRAINING, _WINNER)
            failed = [name for name in names if not len(values[name])]
            if failed:
                reason = f"{failed[0]} fails with every seed"
            else:
                found = attribute(*(values[name] for name in names))
        left_out = tuple(
            _left_out(number, made, values) for number, made in sorted(changes.items())
        )
        return Ablated(winner.number, baseline.number, self.seeds, found, reason, left_out)

    def _crossing(self, winner: Experiment, baseline: Experiment) -> tuple[dict[str, Variant], str]:
        """The other three of the four, or why there are none."""
        best, first = self._source(winner), self._source(baseline)
        if baseline.score is None:
            return {}, "the baseline has no score"
        try:
            sources = (first, crossed(best, first), crossed(first, best))
            variants = map(Variant, (_BASELINE, _MODEL, _TRAINING), sources)
            return {variant.name: variant for variant in variants}, ""
        except UserError as error:
            return {}, str(error)

    def _changes(self, winner: Experiment) -> dict[int, Variant | str]:
        """Return for each change of the lineage the winner without it, or the reason why there is
        none.
        """
        line, found = lineage(self.chain.view, winner), dict[int, Variant | str]()
        for before, after in pairwise(line):
            number = after.number
            try:
                source = without_change(*map(self._source, (winner, before, after)))
            except UserError as error:
                found[number] = str(error)
                continue
            name = f"the winner without the change of #{number:02d}"
            found[number] = Variant(name, source) if source else "no part of it is left"
        return found

    def _source(self, experiment: Experiment) -> str:
        return self.store.text(experiment.proposed.source)

    def _fit_all(self, variants: list[Variant]) -> dict[str, Array]:
        """V of each over the seeds, a single value where fits do not depend on them."""
        different = {variant.digest: variant for variant in variants}
        total, done = len(different) * self.seeds, 0
        with self.evaluator.workers.ready_workers():
            for digest, variant in different.items():
                for repeat in range(1, self.seeds + 1):
                    done += 1
                    if self._known(digest, repeat) is None:
                        event = self._fit(variant, repeat)
                        self.chain.append(event)
                        self.on_fit(event, done, total)
                    if self._is_same(digest, repeat):
                        done += self.seeds - repeat
                        break
        return {variant.name: self._values(variant.digest) for variant in variants}

    def _known(self, digest: str, repeat: int) -> AblationFit | None:
        for fit in self.chain.view.ablation_fits:
            if (fit.digest, fit.repeat) == (digest, repeat):
                return fit
        return None

    def _fit(self, variant: Variant, repeat: int) -> AblationFit:
        begin = time.monotonic()
        outcome = self.evaluator.evaluate(variant.source, repeat).outcome
        seconds = time.monotonic() - begin
        source = self.store.put(variant.source.encode())
        identity = variant.name, source, variant.digest, repeat
        if isinstance(outcome, Failure):
            return AblationFit(*identity, failed=outcome.reason.value, seconds=seconds)
        folds = tuple(fold.value for fold in outcome.folds)
        return AblationFit(*identity, outcome.value, folds, seconds=seconds)

    def _is_same(self, digest: str, repeat: int) -> bool:
        """Return whether all folds have the same V as with the seed before, or as in the search, so
        that the seed has no effect.
        """
        last = self._known(digest, repeat)
        assert last is not None
        before = self._known(digest, repeat - 1)
        if before is not None:
            return bool(last.folds) and last.folds == before.folds
        twins = (e for e in self.chain.view.finished if e.proposed.digest == digest and e.score)
        return any(last.folds == tuple(f.value for f in e.score.folds) for e in twins if e.score)

    def _values(self, digest: str) -> Array:
        fits = [self._known(digest, repeat) for repeat in range(1, self.seeds + 1)]
        found = [fit for fit in fits if fit is not None and fit.value is not None]
        alike = len({fit.folds for fit in found}) == 1
        return np.array([fit.value for fit in found[: 1 if alike else None]])


def _left_out(number: int, made: Variant | str, values: dict[str, Array]) -> LeftOut:
    if isinstance(made, str):
        return LeftOut(number, detail=made)
    if not len(values[made.name]) or not len(values[_WINNER]):
        return LeftOut(number, detail="it fails with every seed")
    return LeftOut(number, gain(values[made.name], values[_WINNER]))
