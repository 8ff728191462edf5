"""Pages that describe the model library to agents and users."""

import ast
import inspect
import re
import textwrap
from collections.abc import Iterator
from dataclasses import MISSING, dataclass, fields, is_dataclass
from functools import cache
from itertools import pairwise

from asia._plugins import family_module, library
from asia.agents.library.family import Family
from asia.agents.library.plants import likely_plants
from asia.agents.library.registry import families
from asia.agents.library.space import Span
from asia.agents.view import Facts
from asia.plants.catalogue import Plant
from asia.problem.physics_text import written_physics
from asia.recipe import MODELS, Recipe

# Options of model families and training methods, with the texts of their classes.


@dataclass(frozen=True)
class Option:
    """One setting of a family or of a method."""

    name: str
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
    """The fields of a dataclass, each with the text below it. Raises ValueError for another
    class."""
    if not is_dataclass(settings):
        raise ValueError(f"{settings.__name__} is no dataclass")
    texts: dict[str, tuple[str, str]] = {}
    for owner in reversed(settings.__mro__):
        if not is_dataclass(owner):
            continue
        (node,) = ast.parse(textwrap.dedent(inspect.getsource(owner))).body
        assert isinstance(node, ast.ClassDef)
        for item, below in pairwise([*node.body, None]):
            if not (isinstance(item, ast.AnnAssign) and isinstance(item.target, ast.Name)):
                continue
            text = ""
            if isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant):
                text = " ".join(str(below.value.value).split())
            texts[item.target.id] = ast.unparse(item.annotation), text
    options: list[Option] = []
    for field in fields(settings):
        if not field.name.startswith("_"):
            required = field.default is MISSING and field.default_factory is MISSING
            default = "its own" if field.default is MISSING else repr(field.default)
            kind, text = texts.get(field.name, ("", ""))
            options.append(Option(field.name, "" if required else default, kind, text))
    return tuple(options)


def config_of(package: str, name: str) -> type:
    """The `Config` of a family."""
    return family_module(package, name).Config


def method_of(name: str) -> type:
    """A training method by name."""
    return getattr(library("asia.models.methods"), name)


def about(settings: type) -> str:
    """The first paragraph that a class says of itself, on one line."""
    return " ".join((inspect.getdoc(settings) or "").split("\n\n")[0].split())


def first_sentence(text: str) -> str:
    """Up to the first full stop that ends one."""
    found = re.match(r"(.+?[.])(?:\s+[A-Z\"]|$)", text)
    return found.group(1) if found else text


# Pages of the model library for agents and users: the families that suit a problem, and one family
# in full.


_WIDTH = 100
MOST_LINES = 92
"""Length of the page. Families are explained in the order of their aptness while there is room."""


def families_page(facts: Facts) -> str:
    """The families that suit a problem, Markdown: all of them with their expected time, and as many
    as there is room for with every option."""
    rows = families(facts)
    recipes = [row.trial(facts) for row in rows]
    lines = _wrapped(
        "Families of `asia.models` that suit this problem. Their order is a guess: none was fitted "
        "yet. A candidate may use one, change it, or be a model of its own. s: expected seconds of "
        "one fold's fit on an ordinary core, with few and many iterations. `asia models NAME` "
        "prints all about one family."
    )
    if facts.physics is None:
        found = ", ".join(f"`{one.plant.name}`" for one in likely_plants(facts)) or "none"
        lines += _wrapped(
            "`asia models` lists plants with known equations, `asia models PLANT` prints them. "
            f"This problem looks like: {found}."
        )
    lines += ["", "| family | what it is for | trained by | s |", "|---|---|---|---|"]
    if facts.physics is None:
        lines.append(
            "| `greybox` | equations of your own (at the end), first where balances of mass, energy"
            " or forces are plausible; known constants and a working point are welcome "
            "| `LevenbergMarquardt` | - |"
        )
    for row, recipe in zip(rows, recipes, strict=True):
        fits = (recipe, row.full(facts))
        seconds = dict.fromkeys(f"{max(1.0, row.seconds(facts, fit)):.0f}" for fit in fits)
        where = "" if row.package == MODELS else f" (package `{row.package}`)"
        lines.append(
            f"| `{row.name}`{where} | {row.use} | `{recipe.method}` | {' to '.join(seconds)} |"
        )
    if rows:
        lines += [
            "",
            "Every family is called like this. An option left out has the default given below.",
        ]
        lines += ["", *_example(recipes[0], rows[0].label)]
    explained: set[str] = set()
    for row, recipe in zip(rows, recipes, strict=True):
        section = ["", f"## {row.name}.Config"]
        for option in options_of(config_of(row.package, row.name)):
            section += _item(option.line)
        if recipe.method not in explained:
            # Without a score on the held-out part these do nothing.
            left_out = () if facts.early_stopping == "validation" else ("stop", "every", "patience")
            options = options_of(method_of(recipe.method))
            section += ["", f"## {recipe.method}"]
            section += _wrapped(" ".join(o.line for o in options if o.name not in left_out))
        if len(lines) + len(section) > MOST_LINES:
            break
        explained.add(recipe.method)
        lines += section
    if any(recipe.method == "Adam" for recipe in recipes) and "Adam" not in explained:
        # There is no room for the options of network training.
        lines += ["", "The options of `Adam`: `asia models NAME` of a family that it trains."]
    return "\n".join(lines) + "\n"


def family_page(row: Family, facts: Facts | None) -> str:
    """All there is to know of one family; with an example where there is a problem it suits."""
    module = family_module(row.package, row.name)
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
    choices = (*space.config, *space.options)
    if choices:
        parts += ["", "## Ranges that the agents of ASIA search", ""]
    for choice in choices:
        if isinstance(choice, Span):
            values = f"{choice.low:g} to {choice.high:g}"
        else:
            values = ", ".join(str(value) for value in choice.values)
        parts.append(f"- `{choice.name}`: {values}")
    parts += ["", "## Example", "", *_example(recipes[0], row.label)]
    return "\n".join(parts) + "\n"


def plant_page(plant: Plant) -> str:
    """The entry of a plant: what is known of it, and its equations in the sizes of an example."""
    entry = plant.entry
    parts = [f"# {plant.name}: {plant.title}", ""]
    parts += _item(f"Source: {entry.source}")
    parts += _item(f"Usual effects: {', '.join(entry.effects)}")
    parts += _item(f"Not determined: {entry.unknown}")
    return "\n".join([*parts, "", "```toml", written_physics(plant.example()).strip(), "```", ""])


def _example(recipe: Recipe, label: str) -> list[str]:
    source = recipe.source(f"{label}.".capitalize()).strip().replace("\n\n\n", "\n\n")
    return ["```python", *source.splitlines(), "```"]


def _full_lines(options: tuple[Option, ...]) -> Iterator[str]:
    for option in options:
        default = f" = {option.default}" if option.default else ""
        yield from _item(f"`{option.name}: {option.kind}{default}`: {option.text}")


def _item(text: str) -> list[str]:
    return textwrap.wrap(f"- {text}", _WIDTH, subsequent_indent="  ", break_long_words=False)


def _wrapped(text: str) -> list[str]:
    return textwrap.wrap(" ".join(text.split()), _WIDTH, break_long_words=False)
