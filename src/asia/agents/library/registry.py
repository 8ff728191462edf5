"""All model families that the agents know, those of other packages too.

Every function raises UserError as `all_cards` does.
"""

import ast
from functools import cache
from pathlib import Path
from typing import cast

from asia._plugins import Part, family_module, parts_of
from asia.agents.library import cards
from asia.agents.library.family import Family
from asia.agents.library.move import Card
from asia.agents.view import Facts
from asia.candidate import source_tree
from asia.errors import CandidateError, UserError
from asia.recipe import MODELS

GROUP = "asia.families"


@cache
def all_cards() -> tuple[Card, ...]:
    """The built-in cards, then those of other packages. Raises UserError for a part that is no
    card, or brings a family with a name that is taken."""
    names = sorted(path.stem for path in Path(cards.__path__[0]).glob("[a-z]*.py"))
    found = [cast("Card", family_module(cards.__name__, n).CARD) for n in names]
    owners = {row.name: "ASIA" for card in found for row in card.families}
    for part in parts_of(GROUP):
        card = _card(part.load(), part)
        found.append(card)
        for row in card.families:
            where = f"package {part.package}, family '{row.name}'"
            if row.name in owners:
                raise UserError(
                    f"{where}: {owners[row.name]} has a family of this name; rename it or "
                    "uninstall the package"
                )
            if row.package == MODELS:
                raise UserError(
                    f"{where}: its card says that candidates import it from {MODELS}; set `package`"
                )
            owners[row.name] = f"package {part.package}"
    return tuple(found)


@cache
def all_families() -> tuple[Family, ...]:
    """Every row, in the order of rows that are equally apt."""
    rows = [row for card in all_cards() for row in card.families]
    return tuple(sorted(rows, key=lambda row: row.place))


def families(facts: Facts) -> tuple[Family, ...]:
    """The rows that suit a problem, the most apt first."""
    rows = [row for row in all_families() if row.suits(facts)]
    return tuple(sorted(rows, key=lambda row: -row.aptness(facts)))


def imported_families(source: str) -> str:
    """Return the names of the families that a candidate imports, such as `greybox, linear`; "" for
    none and for a source that is no Python."""
    try:
        tree = source_tree(source)
    except CandidateError:
        return ""
    imported = [
        name
        for node in tree.body
        if isinstance(node, ast.ImportFrom) and node.module is not None
        for alias in node.names
        for name in (f"{node.module}.{alias.name}", node.module)
    ]
    known = {f"{row.package}.{row.name}": row.name for row in all_families()}
    return ", ".join(dict.fromkeys(known[name] for name in imported if name in known))


def family(name: str) -> Family | None:
    """A row by name."""
    return next((row for row in all_families() if row.name == name), None)


def _card(part: object, source: Part) -> Card:
    """Make a card from a part of a package: a card, a family, or several families."""
    if isinstance(part, Card):
        return part
    rows = part if isinstance(part, tuple) else (part,)
    families = tuple(row for row in cast("tuple[object, ...]", rows) if isinstance(row, Family))
    if not families or len(families) != len(cast("tuple[object, ...]", rows)):
        raise UserError(
            f"{source.name} of package {source.package}: {source.target} is no Card, no Family and "
            "no tuple of families (asia.agents.library)"
        )
    return Card(families)
