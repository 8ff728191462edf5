"""Candidates of the model library as data: written as short sources, read back from them."""

from __future__ import annotations

import ast
from dataclasses import dataclass, replace
from typing import Literal

Value = int | float | str | bool | None | tuple[str, ...]
Settings = tuple[tuple[str, Value], ...]
Method = Literal["Adam", "LevenbergMarquardt"]

_TEMPLATE = '''"""{summary}"""

from asia.models import {family}
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
_LINE = 80


@dataclass(frozen=True)
class Recipe:
    """A family of `asia.models` with its settings, and a training method with its own."""

    family: str
    config: Settings
    method: Method
    options: Settings

    def get(self, name: str, default: Value = None) -> Value:
        """A setting of the model or of the method."""
        return dict((*self.config, *self.options)).get(name, default)

    def number(self, name: str, default: float) -> float:
        """A numeric setting; `default` when it is absent or not a number."""
        value = self.get(name, default)
        return float(value) if isinstance(value, int | float) else default

    def configured(self, **changes: Value) -> Recipe:
        """With settings of the model changed."""
        return replace(self, config=_merge(self.config, changes))

    def trained(self, **changes: Value) -> Recipe:
        """With settings of the method changed."""
        return replace(self, options=_merge(self.options, changes))

    def source(self, summary: str) -> str:
        """The candidate.py."""
        return _TEMPLATE.format(
            summary=summary.replace('"""', "'''"),
            family=self.family,
            method=self.method,
            config=_call(f"{self.family}.Config", self.config),
            options=_call(self.method, self.options),
        )


def read_recipe(source: str) -> Recipe | None:
    """The recipe a source was written from; None when a person or another agent wrote it."""
    try:
        tree = ast.parse(source)
    except (SyntaxError, ValueError):
        return None
    family, config, method, options = "", None, None, None
    for node in ast.walk(tree):
        if not isinstance(node, ast.Call):
            continue
        target = node.func
        if isinstance(target, ast.Attribute) and target.attr == "Config":
            family = target.value.id if isinstance(target.value, ast.Name) else ""
            config = _keywords(node)
        elif isinstance(target, ast.Name) and target.id in ("Adam", "LevenbergMarquardt"):
            method, options = target.id, _keywords(node)
    if not family or config is None or options is None:
        return None
    return Recipe(family, config, "Adam" if method == "Adam" else "LevenbergMarquardt", options)


def _keywords(call: ast.Call) -> Settings | None:
    try:
        return tuple((k.arg or "", ast.literal_eval(k.value)) for k in call.keywords)
    except ValueError:
        return None


def _merge(settings: Settings, changes: dict[str, Value]) -> Settings:
    return tuple({**dict(settings), **changes}.items())


def _call(name: str, settings: Settings) -> str:
    arguments = [f"{key}={value!r}" for key, value in settings]
    flat = f"{name}({', '.join(arguments)})"
    if len(flat) <= _LINE:
        return flat.replace("'", '"')
    inner = "".join(f"        {argument},\n" for argument in arguments)
    return f"{name}(\n{inner}    )".replace("'", '"')
