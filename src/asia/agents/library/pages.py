"""Pages that describe the model library to agents and users."""

from __future__ import annotations

import ast
import inspect
import re
import textwrap
from collections.abc import Iterator
from dataclasses import MISSING, Field, dataclass, fields, is_dataclass
from functools import cache
from importlib import import_module
from typing import Any

from asia.agents.library.family import Family
from asia.agents.library.recipe import MODELS, Recipe
from asia.agents.library.registry import families
from asia.agents.library.space import OneOf, Span
from asia.agents.view import Facts

# Options of model families and training methods, with the texts of their classes.


METHODS = "asia.models.methods"


@dataclass(frozen=True)
class Option:
    """One setting of a family or of a method."""

    name: str
    """Name of the option."""
    default: str
    """Default, as source; "" where it is required."""
    kind: str
    """Type, as source."""
    text: str
    """Description, in sentences."""

    @property
    def line(self) -> str:
        """`name=default` and its first sentence."""
        given = f"{self.name}={self.default}" if self.default else self.name
        return f"`{given}`: {first_sentence(self.text)}"


@cache
def options_of(settings: type) -> tuple[Option, ...]:
    """The fields of a dataclass, each with the text below it.

    Raises:
        ValueError: for another class
    """
    if not is_dataclass(settings):
        raise ValueError(f"{settings.__name__} is no dataclass")
    texts: dict[str, tuple[str, str]] = {}
    for owner in reversed(settings.__mro__):
        if is_dataclass(owner):
            texts.update(_texts(owner))
    return tuple(
        Option(field.name, _default(field), *texts.get(field.name, ("", "")))
        for field in fields(settings)
        if not field.name.startswith("_")
    )


def config_of(package: str, name: str) -> type:
    """The `Config` of a family."""
    return import_module(f"{package}.{name}").Config


def method_of(name: str) -> type:
    """A training method by name."""
    return getattr(import_module(METHODS), name)


def about(settings: type) -> str:
    """The first paragraph that a class says of itself, on one line."""
    return " ".join((inspect.getdoc(settings) or "").split("\n\n")[0].split())


def first_sentence(text: str) -> str:
    """Up to the first full stop that ends one."""
    found = re.match(r"(.+?[.])(?:\s+[A-Z\"]|$)", text)
    return found.group(1) if found else text


def _texts(owner: type) -> dict[str, tuple[str, str]]:
    """Type and text of each field that the class itself has."""
    (node,) = ast.parse(textwrap.dedent(inspect.getsource(owner))).body
    assert isinstance(node, ast.ClassDef)
    answer: dict[str, tuple[str, str]] = {}
    for place, item in enumerate(node.body):
        if not (isinstance(item, ast.AnnAssign) and isinstance(item.target, ast.Name)):
            continue
        below = node.body[place + 1] if place + 1 < len(node.body) else None
        text = ""
        if isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant):
            text = " ".join(str(below.value.value).split())
        answer[item.target.id] = ast.unparse(item.annotation), text
    return answer


def _default(field: Field[Any]) -> str:
    if field.default is MISSING:
        return "" if field.default_factory is MISSING else "its own"
    return repr(field.default)


# Pages of the model library for agents and users: the families that suit a problem, and one family
# in full.


_WIDTH = 100
MOST_LINES = 92
"""Length of the page. Families are explained in the order of their aptness while there is room."""


def families_page(facts: Facts) -> str:
    """The families that suit a problem, Markdown: all of them with their expected time, and as many
    as there is room for with every option."""
    rows = families(facts)
    lines = [*_wrapped(_ABOUT), "", *_table(rows, facts)]
    if rows:
        lines += ["", *_wrapped(_EXAMPLE), "", *_example(rows[0].trial(facts), rows[0].label)]
    explained: set[str] = set()
    for row in rows:
        recipe = row.trial(facts)
        section = [*_family_lines(row)]
        if recipe.method not in explained:
            section += _method_lines(recipe.method, facts)
        if len(lines) + len(section) > MOST_LINES:
            break
        explained.add(recipe.method)
        lines += section
    if any(row.trial(facts).method == "Adam" for row in rows) and "Adam" not in explained:
        lines += _adam_lines()
    return "\n".join(lines) + "\n"


def family_page(row: Family, facts: Facts | None) -> str:
    """All there is to know of one family; with an example where there is a problem it suits."""
    module = import_module(f"{row.package}.{row.name}")
    parts = [f"# {row.name}: {row.label}", "", *_wrapped(f"{row.use}.".capitalize()), ""]
    parts += [*(inspect.getdoc(module) or "").splitlines(), ""]
    parts += [f"## {row.name}.Config", "", *_wrapped(about(config_of(row.package, row.name))), ""]
    parts += _full_lines(options_of(config_of(row.package, row.name)))
    if facts is None:
        return "\n".join(parts) + "\n"
    recipes = [row.trial(facts)]
    recipes += [change(facts, recipes[0]) for change in row.methods]
    for name in dict.fromkeys(recipe.method for recipe in recipes):
        method = method_of(name)
        parts += ["", f"## {name}, to train it", "", *_wrapped(about(method)), ""]
        parts += _full_lines(options_of(method))
    space = row.space(facts)
    varied = [_varied(choice) for choice in (*space.config, *space.options)]
    if varied:
        parts += ["", "## Ranges that the agents of ASIA search", ""]
        parts += [f"- {words}" for words in varied]
    parts += ["", "## Example", "", *_example(recipes[0], row.label)]
    return "\n".join(parts) + "\n"


_ABOUT = """Families of `asia.models` that suit this problem, the most apt first. A candidate may
use one, change it, or be a model of its own. s: expected seconds of one fold's fit on an ordinary
core, with few and many iterations. `asia models NAME` prints all about one family."""
_ADAM = ("steps", "learning_rate", "schedule", "weight_decay", "clip")
# Without a score on the held-out part these do nothing.
_SCORED = ("stop", "every", "patience")
_EXAMPLE = "Every family is called like this. An option left out has the default given below."


def _table(rows: tuple[Family, ...], facts: Facts) -> Iterator[str]:
    yield "| family | what it is for | trained by | s |"
    yield "|---|---|---|---|"
    for row in rows:
        first, long = row.trial(facts), row.full(facts)
        seconds = [f"{max(1.0, row.seconds(facts, recipe)):.0f}" for recipe in (first, long)]
        where = "" if row.package == MODELS else f" (package `{row.package}`)"
        yield (
            f"| `{row.name}`{where} | {row.use} | `{first.method}` | "
            f"{' to '.join(dict.fromkeys(seconds))} |"
        )


def _example(recipe: Recipe, label: str) -> list[str]:
    source = recipe.source(f"{label}.".capitalize()).strip().replace("\n\n\n", "\n\n")
    return ["```python", *source.splitlines(), "```"]


def _family_lines(row: Family) -> Iterator[str]:
    yield from ("", f"## {row.name}.Config")
    yield from _short_lines(options_of(config_of(row.package, row.name)))


def _method_lines(name: str, facts: Facts) -> Iterator[str]:
    yield from ("", f"## {name}")
    scored = facts.early_stopping == "validation"
    options = [one for one in options_of(method_of(name)) if scored or one.name not in _SCORED]
    yield from _wrapped(" ".join(one.line for one in options))


def _adam_lines() -> list[str]:
    """List the main options of network training, where there is no room for all of them."""
    options = {one.name: one.line for one in options_of(method_of("Adam"))}
    said = " ".join(options[name] for name in _ADAM)
    return ["", *_wrapped(f"**Adam**, all of it in `asia models NAME` of such a family: {said}")]


def _short_lines(options: tuple[Option, ...]) -> Iterator[str]:
    for option in options:
        yield from textwrap.wrap(
            f"- {option.line}", _WIDTH, subsequent_indent="  ", break_long_words=False
        )


def _full_lines(options: tuple[Option, ...]) -> Iterator[str]:
    for option in options:
        default = f" = {option.default}" if option.default else ""
        text = f"- `{option.name}: {option.kind}{default}`: {option.text}"
        yield from textwrap.wrap(text, _WIDTH, subsequent_indent="  ", break_long_words=False)


def _wrapped(text: str) -> list[str]:
    return textwrap.wrap(" ".join(text.split()), _WIDTH, break_long_words=False)


def _varied(choice: OneOf | Span) -> str:
    if isinstance(choice, Span):
        return f"`{choice.name}`: {choice.low:g} to {choice.high:g}"
    return f"`{choice.name}`: {', '.join(str(value) for value in choice.values)}"
