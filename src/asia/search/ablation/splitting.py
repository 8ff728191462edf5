"""Candidates in the standard layout, taken apart into model and training and put together anew."""

from __future__ import annotations

import ast
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

from asia._syntax import syntax_tree
from asia.agents.library.recipe import Arguments, Recipe, read_recipe
from asia.candidate import source_digest
from asia.errors import UserError

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
