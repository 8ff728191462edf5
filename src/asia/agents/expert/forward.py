"""Agent that builds a model by forward selection of effects.

1. Families of what the user gave, equations or a simulator, come first, then the ladder of families
   in the order of their aptness, for the first part of the budget. An effect that explains more
   than a third of the residual of the best candidate interrupts it.
2. Effects are added to the best candidate, by the share of the residual that they explain. One that
   does not help is struck out for this candidate.
3. The best candidate of another family is carried on as well while its error over the folds is
   within one standard error of the best.
4. Where nothing points at an effect, or two in a row did not help, the next family of the ladder
   gets its trial. Effects that nothing points at come last.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from functools import partial
from itertools import takewhile
from math import sqrt
from statistics import fmean, stdev

from asia.agents.expert.agent import (
    GIVEN,
    NEAR,
    SURE,
    ExpertAgent,
    Option,
    moved,
    situations,
    untried,
)
from asia.agents.expert.diagnosis import answers, beats_nothing, diagnoses, keeps_course
from asia.agents.expert.moves import all_moves
from asia.agents.library.move import Situation, plain_title
from asia.agents.library.registry import family
from asia.agents.view import AgentView, Proposal, Running, Trial

INTERRUPTS = 1 / 3
"""Share of the residual that an effect must explain to come before the next family."""
LIKELY, _HINT = 0.7, 0.2
"""Weight of a move from which the residual points at it, and the share that counts for it."""
PATIENCE = 2
"""Effects in a row without a gain after which another family is tried."""


class ForwardAgent(ExpertAgent):
    """Agent with a ladder of families and forward selection of effects."""

    name = "forward"

    def _best_of(self, view: AgentView, unwanted: set[str]) -> Proposal | None:
        found, new = (
            [option for option in options if not {option.family, option.move} & unwanted]
            for options in (effects(view), untried(view))
        )
        given = [option for option in new if option.family in GIVEN]
        shown = [option for option in found if option.weight >= INTERRUPTS]
        likely = [option for option in found if option.weight > 0.0]
        ladder = [option for option in new if option.apt]
        waiting = view.phase == "explore" or _idle(view) >= PATIENCE
        turns = [*given, *shown, *(ladder if waiting else ()), *likely, *ladder, *found, *new]
        return next((p for option in turns if (p := option.make()) is not None), None)


def effects(view: AgentView) -> Iterator[Option]:
    """Effects that may be added to the candidates that are carried on, in the order in which they
    are tried; `weight` is the share of the residual that is known to be explained."""
    lost, answer = beats_nothing(view), answers(view)
    shares = dict(diagnoses(view))
    share = next(iter(shares.values()), 0.0)
    ranked: list[tuple[tuple[float, ...], Option]] = []
    for place, at in enumerate(carried(view)):
        for order, move in enumerate(all_moves()):
            possible = move.weight(at) if move.applies(at) else 0.0
            if possible <= 0.0 or (lost and not keeps_course(move)):
                continue
            evidence = 1.0 if possible >= SURE else _HINT if possible >= LIKELY else 0.0
            evidence = max(evidence, share if move.name in answer else 0.0)
            title = move.title(at)
            tries = sum(_without_gain(one) for one in view.proposed if _is(one, title))
            recipe = at.recipe if move.same_effort else move.change(at)
            option = Option(
                at.row.name, evidence / (1 + tries), partial(moved, at, move),
                at.row.seconds(at.facts, recipe), move=move.name,
            )  # fmt: skip
            key = tries, -evidence, -answer.get(move.name, 0.0), -possible, place, order
            ranked.append((key, option))
    yield from (option for _, option in sorted(ranked, key=lambda one: one[0]))


def carried(view: AgentView) -> Iterable[Situation]:
    """The best candidate, that of one other family within one standard error, that of equations to
    which terms can still be added, and families that only failed."""
    best, other = view.best, False
    for at in situations(view):
        if at.trial.value is None or best is None:
            yield at
            continue
        doubtful = at.place > 0 and at.row.doubtful(view.facts)
        close = not other and _within_error(best, at.trial)
        leader = family(best.family)
        black_box = leader is None or leader.kind != "equations"
        assert best.value is not None
        growing = at.row.extendable and black_box and best.value > NEAR * at.trial.value
        if at.place == 0 or beats_nothing(view) or ((close or growing) and not doubtful):
            other |= at.place > 0 and not growing
            yield at


def _within_error(best: Trial, trial: Trial) -> bool:
    """Whether V is above the best by no more than the standard error over the folds."""
    behind = [b - a for a, b in zip(best.folds, trial.folds, strict=False)]
    if len(behind) < 2:
        return False
    return fmean(behind) <= stdev(behind) / sqrt(len(behind))


def _is(one: Trial | Running, title: str) -> bool:
    return plain_title(one.title) == title


def _without_gain(one: Trial | Running) -> bool:
    return isinstance(one, Running) or not one.improved


def _idle(view: AgentView) -> int:
    """Effects in a row, up to now, that did not help."""
    last = takewhile(lambda one: one.parent is not None and _without_gain(one), view.proposed[::-1])
    return sum(1 for _ in last)
