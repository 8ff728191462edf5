"""Candidates of the model library as data: written as short sources, read back from them."""

from __future__ import annotations

import ast
import re
from collections.abc import Hashable
from dataclasses import dataclass, replace
from functools import lru_cache

from asia.candidate import source_digest, source_tree
from asia.errors import CandidateError

Value = int | float | str | bool | None | tuple[str | int | float, ...]
Arguments = tuple[tuple[str, Value], ...]

MODELS = "asia.models"
GRADIENT = ("Adam", "LBFGS", "MultipleShooting")
"""Methods that follow the gradient and can stop early."""
_METHODS = "asia.models.methods"
_MAPS = "static_maps"
_TEMPLATE = '''"""{summary}"""

from {package} import {family}
from asia.models.methods import {method}


def build_model(context):
    config = {config}
    return {family}.build(config, context)


def train(model, trajectories, context):
    method = {options}
    return {family}.train(model, trajectories, context, method)


def fit(trajectories, context):
    return train(build_model(context), trajectories, context)
'''


# With static functions around the model.
_MAPPED = '''"""{summary}"""

from {package} import {family}
from asia.models import static_maps
from asia.models.methods import {method}


def build_model(context):
    maps = {maps}
    config = {config}
    return static_maps.build(maps, {family}.build(config, context))


def train(model, trajectories, context):
    method = {options}
    return static_maps.train({family}.train, model, trajectories, context, method)


def fit(trajectories, context):
    return train(build_model(context), trajectories, context)
'''


@dataclass(frozen=True)
class Recipe:
    """A model family with its settings, and a training method with its own."""

    family: str
    """Module of the family."""
    config: Arguments
    """Settings of the model: keyword arguments of the family's `Config`."""
    method: str
    """Training method, one of `asia.models.methods`."""
    options: Arguments
    package: str = MODELS
    maps: Arguments = ()
    """Static functions around the model: keyword arguments of `static_maps.Config`."""

    @property
    def key(self) -> Hashable:
        """Identity of the recipe, regardless of the order of settings."""
        settings = frozenset(self.config), frozenset(self.options), frozenset(self.maps)
        return self.package, self.family, self.method, *settings

    @property
    def settings(self) -> dict[str, Value]:
        """Settings of the model, of the method and of the static functions."""
        return dict((*self.config, *self.options, *self.maps))

    def get(self, name: str, default: Value = None) -> Value:
        """A setting of the model, of the method or of the static functions."""
        return self.settings.get(name, default)

    def number(self, name: str, default: float) -> float:
        """A numeric setting; `default` when it is absent or not a number."""
        value = self.get(name, default)
        if isinstance(value, bool) or not isinstance(value, int | float):
            return default
        return float(value)

    def has(self, name: str) -> bool:
        """Return whether the source names the setting."""
        return any(key == name for key, _ in (*self.config, *self.options))

    def configured(self, **changes: Value) -> Recipe:
        """Return the recipe with settings of the model changed."""
        return replace(self, config=tuple({**dict(self.config), **changes}.items()))

    def without(self, *names: str) -> Recipe:
        """Return the recipe with the defaults of some settings of the model."""
        return replace(self, config=tuple(s for s in self.config if s[0] not in names))

    def mapped(self, **changes: Value) -> Recipe:
        """Return the recipe with static functions around the model changed; None removes one."""
        maps = {**dict(self.maps), **changes}
        return replace(self, maps=tuple((k, v) for k, v in maps.items() if v is not None))

    def trained(self, **changes: Value) -> Recipe:
        """Return the recipe with settings of the method changed."""
        return replace(self, options=tuple({**dict(self.options), **changes}.items()))

    def fitted_by(self, method: str, options: Arguments) -> Recipe:
        """Return the recipe with another training method."""
        return replace(self, method=method, options=options)

    def times(self, name: str, factor: float, default: float) -> Recipe:
        """Return the recipe with a number multiplied, to two significant digits.

        Args:
            default: the number of a setting that the recipe does not name
        """
        number = float(f"{factor * self.number(name, default):.2g}")
        return (
            self.changed(**{name: number}) if self.has(name) else self.configured(**{name: number})
        )

    def changed(self, **changes: Value) -> Recipe:
        """Return the recipe with settings of the model or the method changed. Raises KeyError for a
        setting of neither."""
        recipe = self
        for name, value in changes.items():
            if name in dict(self.config):
                recipe = recipe.configured(**{name: value})
            elif name in dict(self.options):
                recipe = recipe.trained(**{name: value})
            else:
                raise KeyError(name)
        return recipe

    def source(self, summary: str) -> str:
        """The candidate.py."""
        return (_MAPPED if self.maps else _TEMPLATE).format(
            maps=_call(f"{_MAPS}.Config", self.maps),
            summary=summary.replace('"""', "'''"),
            package=self.package,
            family=self.family,
            method=self.method,
            config=_call(f"{self.family}.Config", self.config),
            options=_call(self.method, self.options),
        )


@lru_cache(maxsize=4096)
def read_recipe(source: str) -> Recipe | None:
    """Return the recipe that is equivalent to a source; None for a source with further code, such
    as that of a user or another agent."""
    try:
        tree = source_tree(source)
        imported = [
            (node.module, alias.name)
            for node in tree.body
            if isinstance(node, ast.ImportFrom) and node.module is not None
            for alias in node.names
        ]
        (method,) = (name for module, name in imported if module == _METHODS)
        has_maps = (MODELS, _MAPS) in imported
        ((package, family),) = (
            pair for pair in imported if pair[0] != _METHODS and pair != (MODELS, _MAPS)
        )
        config, options = _settings(tree, f"{family}.Config"), _settings(tree, method)
        maps = _settings(tree, f"{_MAPS}.Config") if has_maps else ()
        found = Recipe(family, config, method, options, package, maps)
        same = source_digest(found.source("")) == source_digest(source)
    except (SyntaxError, ValueError, CandidateError):
        return None
    return found if same else None


EQUATIONS = "equations"
"""Name of a variant, before the number of its equations."""


def with_chosen_equations(recipe: Recipe, variant: str) -> Recipe:
    """Return the recipe with the equations of a variant alone, where it brings several."""
    texts, number = recipe.get("physics"), variant.removeprefix(f"{EQUATIONS} ")
    if not isinstance(texts, tuple) or not number.isdigit():
        return recipe
    return recipe.configured(physics=(texts[int(number) - 1],))


def _settings(tree: ast.Module, function: str) -> Arguments:
    """Keyword arguments of the one call of `function`. Raises ValueError for another number of
    calls, and for arguments that are no literals."""
    calls = (n for n in ast.walk(tree) if isinstance(n, ast.Call))
    (call,) = (c for c in calls if ast.unparse(c.func) == function)
    return tuple((k.arg or "", ast.literal_eval(k.value)) for k in call.keywords)


def _call(name: str, settings: Arguments) -> str:
    arguments = [f"{key}={_literal(value)}" for key, value in settings]
    flat = f"{name}({', '.join(arguments)})"
    if len(flat) <= 80:
        return flat
    inner = "".join(f"        {argument},\n" for argument in arguments)
    return f"{name}(\n{inner}    )"


def _literal(value: Value) -> str:
    """Python's own notation, strings in double quotes where they hold none."""
    if isinstance(value, tuple):
        items = [_literal(item) for item in value]
        return f"({', '.join(items)}{',' if len(items) == 1 else ''})"
    if isinstance(value, str) and "\n" in value and not re.search(r"\\|'''|\'$", value):
        return f"'''\\\n{value}'''"
    text = repr(value)
    plain = isinstance(value, str) and '"' not in value and "\\" not in text
    return f'"{text[1:-1]}"' if plain else text
