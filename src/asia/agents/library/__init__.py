"""Model library for agents, and the types of a family's card."""

from asia.agents.library.card import Card
from asia.agents.library.family import Family
from asia.agents.library.methods import adam, by_lbfgs, by_multiple_shooting
from asia.agents.library.move import Move, Situation
from asia.agents.library.network import NetworkStart, network_family
from asia.agents.library.recipe import Arguments, Recipe, read_recipe
from asia.agents.library.space import OneOf, Space, Span
from asia.agents.library.traits import Trait

__all__ = [
    "Arguments",
    "Card",
    "Family",
    "Move",
    "NetworkStart",
    "OneOf",
    "Recipe",
    "Situation",
    "Space",
    "Span",
    "Trait",
    "adam",
    "by_lbfgs",
    "by_multiple_shooting",
    "network_family",
    "read_recipe",
]
