"""The arms of a comparison with the paper."""

from __future__ import annotations

from functools import partial

from asia.agents import make_agent
from asia.bench._paper import Paper
from asia.bench._plan import Arm
from asia.bench._references import reference_agent

ARM_NAMES = ("expert", "random", "random-paper", "references")


def make_arms(paper: Paper | None) -> tuple[Arm, ...]:
    """Return all arms of `ARM_NAMES`; the references only if the paper has some."""
    searches = (
        Arm("expert", "expert", partial(make_agent, "expert")),
        Arm("random", "random, library space", partial(make_agent, "random")),
        Arm("random-paper", "random, paper's space", partial(make_agent, "random", "paper")),
    )
    if paper is None or not paper.references:
        return searches
    names = paper.references
    return (*searches, Arm("references", "references", partial(reference_agent, names), len(names)))
