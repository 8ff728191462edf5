"""Menu of a language model: ready candidates to choose from, as text and as a JSON schema."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import chain, islice
from typing import Any

import numpy as np

from asia._text import one_line
from asia.agents.expert.agent import Option, effects, recognised, untried
from asia.agents.library.move import plain_title
from asia.agents.library.registry import family
from asia.agents.library.space import Span, applies
from asia.agents.llm.prompt import bounded, signal_lines, trial_line
from asia.agents.llm.reply import Choice, MalformedReplyError
from asia.agents.view import AgentView, Facts, Proposal
from asia.problem.metrics import metric_label
from asia.recipe import Recipe, Value, read_recipe

_MOST = 8
# Settings of a candidate, values of a setting, characters of a reason.
_SETTINGS = 4
_VALUES = 5
_REASON = 200
# Lines of evidence on the best trial, experiments and characters of the description.
_EVIDENCE = 12
_TRIALS = 8
_DESCRIPTION = 1000

_ROLE = """\
You are an expert in system identification. You search for the best model of a dynamical system. A
trusted evaluator fits each candidate on the training folds and simulates the held-out parts. V is
the normalised {metric}: lower is better, 1 is what the mean of the outputs gives. Each candidate on
the menu is ready to run. Choose the one that is most likely to lower V: read the evidence on the
best experiment, do not repeat what did not help, and try new families as well as refinements."""

# Without an example: small models copy its number.
CHOICE = """\
Answer with a JSON object and nothing else. `reason` says in one sentence what in the evidence
speaks for the candidate. `choice` has its `number` on the menu and `settings`, an object with the
settings that you change; it may be empty."""


@dataclass(frozen=True)
class Offer:
    """Candidate on the menu.

    Attributes:
        seconds: expected duration of a fit
        settings: the values that may be chosen, the present one first
    """

    proposal: Proposal
    recipe: Recipe
    seconds: float
    settings: Mapping[str, tuple[Value, ...]]

    def line(self, number: int) -> str:
        """Describe the candidate in one line."""
        p = self.proposal
        parts = [
            f"{number}. {p.title} ({'a new family' if p.parent is None else f'from #{p.parent}'})",
            p.hypothesis.removesuffix("."),
            f"A fit takes about {self.seconds:.2g} s",
        ]
        if self.settings:
            varied = [f"{name} {'|'.join(map(str, v))}" for name, v in self.settings.items()]
            parts.append(f"Settings, the present value first: {', '.join(varied)}")
        return ". ".join(parts) + "."

    def chosen(self, choice: Choice) -> Proposal:
        """Return the candidate with the chosen settings and the reason.

        Raises:
            MalformedReplyError: for a setting or a value that is not offered
        """
        p = self.proposal
        changes: dict[str, Value] = {}
        for name, value in choice.settings.items():
            # 1, 1.0 and True are equal in Python, not in a recipe.
            same = [v for v in self.settings.get(name, ()) if repr(v) == repr(value)]
            if not same:
                pair = one_line(f"{name} = {value}", 80)
                raise MalformedReplyError(f"candidate {choice.number} does not offer {pair}")
            if value != self.settings[name][0]:
                changes[name] = same[0]
        reason = one_line(choice.reason, _REASON) or "none given"
        p = replace(p, hypothesis=f"{p.hypothesis} Reason of the language model: {reason}")
        if not changes:
            return p
        words = [f"{name} {value}" for name, value in changes.items()]
        source = self.recipe.changed(**changes).source(f"{p.title}, {', '.join(words)}.")
        while len(title := f"{plain_title(p.title)} ({', '.join(words)})") > 80:
            words.pop()
        return replace(p, source=source, title=title.removesuffix(" ()"))


def menu(view: AgentView) -> tuple[Offer, ...]:
    """Return at most eight candidates that were not tried: effects in the order in which the expert
    tries them, and new families, the most apt first. New families lead in the explore phase."""
    new = chain(recognised(view), untried(view))
    groups = [list(islice(_offers(view, group), _MOST)) for group in (effects(view), new)]
    first, second = groups if view.phase == "refine" else reversed(groups)
    first = first[: max(_MOST // 2, _MOST - len(second))]
    return (*first, *second[: _MOST - len(first)])


def _offers(view: AgentView, options: Iterable[Option]) -> Iterator[Offer]:
    seen: set[str] = set()
    for option in options:
        proposal = option.make()
        recipe = None if proposal is None else read_recipe(proposal.source)
        if proposal is None or recipe is None or proposal.source in seen:
            continue
        seen.add(proposal.source)
        yield Offer(proposal, recipe, option.seconds, _settings(recipe, view.facts))


def _settings(recipe: Recipe, facts: Facts) -> dict[str, tuple[Value, ...]]:
    """The first settings that the recipe names and the library varies, with values to choose."""
    row = family(recipe.family)
    space = row.space(facts) if row is not None else None
    found: dict[str, tuple[Value, ...]] = {}
    for parameter in (*space.config, *space.options) if space is not None else ():
        present = recipe.get(parameter.name)
        if not recipe.has(parameter.name) or not applies(parameter, recipe):
            continue
        if isinstance(present, tuple) or present is None or len(found) == _SETTINGS:
            continue
        if isinstance(parameter, Span):
            grid = np.geomspace if parameter.log and parameter.low > 0 else np.linspace
            values = map(parameter.tidy, grid(parameter.low, parameter.high, _VALUES))
        else:
            values = (v for v in parameter.values if not isinstance(v, tuple) and v is not None)
        others = {repr(value): value for value in values}
        others.pop(repr(present), None)
        if others:
            found[parameter.name] = (present, *others.values())
    return found


def menu_lines(offers: tuple[Offer, ...]) -> str:
    """The menu as text, a candidate a line."""
    return "\n".join(offer.line(number) for number, offer in enumerate(offers, 1))


def menu_problem(facts: Facts) -> str:
    """The system message, short enough for a small model."""
    parts = [
        _ROLE.format(metric=metric_label(facts.metric)),
        bounded(facts.description, _DESCRIPTION),
        "\n".join(signal_lines(facts)),
        CHOICE,
    ]
    return "\n\n".join(part for part in parts if part)


def menu_search(view: AgentView, offers: tuple[Offer, ...]) -> str:
    """The user message: the best and the last experiments, evidence on the best one, the menu."""
    kept = {trial.number for trial in (*view.ranked[:3], *view.trials[-_TRIALS:])}
    best = view.best
    parts = [f"{len(view.trials)} experiments done, {view.remaining} left."]
    parts += ["\n".join(trial_line(trial) for trial in view.trials if trial.number in kept)]
    if best is not None:
        parts.append("\n".join((f"Evidence on #{best.number}:", *best.evidence[:_EVIDENCE])))
    parts += [f"Note of the user: {bounded(note, 300)}" for note in view.notes[-3:]]
    parts.append(f"Menu:\n{menu_lines(offers)}")
    return "\n\n".join(parts)


def menu_schema(offers: tuple[Offer, ...]) -> dict[str, Any]:
    """The JSON schema of an answer: a reason, then a number with its own settings."""

    def thing(**properties: object) -> dict[str, Any]:
        required = [name for name in properties if name != "settings"]
        return {
            "type": "object",
            "properties": properties,
            "required": required,
            "additionalProperties": False,
        }

    choices: list[dict[str, Any]] = []
    for number, offer in enumerate(offers, 1):
        values = {name: {"enum": list(found)} for name, found in offer.settings.items()}
        settings = {**thing(**values), "required": []}
        extra = {"settings": settings} if values else {}
        choices.append(thing(number={"const": number}, **extra))
    reason = {"type": "string", "maxLength": _REASON}
    return thing(reason=reason, choice={"anyOf": choices})
