"""Notes of `asia steer` that the expert reads: a family, saturation, friction, a delay."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Literal

from asia.agents.library.family import Family
from asia.agents.library.move import SHOWN, Move, Situation
from asia.agents.library.recipe import Recipe
from asia.agents.library.registry import all_families, family
from asia.agents.view import AgentView

Effect = Literal["family", "saturation", "friction", "delay"]

READS = (
    "the expert reads a family to try or to avoid, saturation, friction, and a delay of N samples"
)
EFFECT_MOVES: dict[Effect, tuple[str, ...]] = {
    "saturation": (
        "{state} runs over",
        "{state} saturates",
        "storages run over",
        "saturated inputs",
        "static function at the output",
        "static function at the input",
    ),
    "friction": (
        "dry friction on {state}",
        "a trace of friction",
        "dry friction",
        "friction or hysteresis",
    ),
}
"""Moves that bring an effect, the preferred one first."""

_TRY = r"try|use|prefer|test|add|include|consider|start with|go on with"
_AVOID = (
    r"avoid|do not|don'?t|never|without|skip|leave out|drop|exclude|instead of|there is no|not|no"
)
# "The system is not linear" asks for nothing.
_VERBS = re.compile(
    rf"\b(?:(?P<says>(?:is|are|was) not|isn't|aren't)|(?P<avoid>{_AVOID})(?: (?:{_TRY}))?"
    rf"|(?P<try>{_TRY}))\b"
)
_EFFECTS: dict[Effect, re.Pattern[str]] = {
    "saturation": re.compile(r"\bsaturat\w*"),
    "friction": re.compile(r"\b(?:(?:dry|coulomb) )?(?:friction|stiction)\b"),
    "delay": re.compile(
        r"\b(?:delay\w*|dead time)[^\d.;]{0,20}(?P<n>\d+) ?(?:samples?|steps?)\b"
        r"|(?P<m>\d+)[ -]?(?:samples?|steps?)(?: of)?(?: pure)? (?:delay|dead time)\b"
    ),
}


@dataclass(frozen=True)
class Wish:
    """One thing that a note asks for."""

    note: int
    """Number of the note, from 1."""
    effect: Effect
    """Effect that the note mentions."""
    avoid: bool = False
    """Whether it is not to be tried."""
    name: str = ""
    """The family."""
    samples: int = 0
    """The delay."""

    @property
    def text(self) -> str:
        """`try polynomial NARX`."""
        row = family(self.name) if self.name else None
        subject = row.label if row is not None else self.effect
        if self.effect == "delay":
            subject = f"a delay of {self.samples} samples"
        return f"{'no' if self.avoid else 'try'} {subject}"

    @property
    def mark(self) -> str:
        """Sentence for the hypothesis of the experiment that follows it."""
        return f"Note {self.note} is followed: {self.text}."

    def is_followed(self, view: AgentView) -> bool:
        """Return whether an experiment says that it followed this note."""
        return any(self.mark in one.hypothesis for one in view.proposed)


def read_notes(notes: Sequence[str]) -> tuple[tuple[Wish, ...], tuple[str, ...]]:
    """The wishes of all notes, and one line for each note that has none."""
    wishes: list[Wish] = []
    answers: list[str] = []
    for number, note in enumerate(notes, 1):
        sentences = re.split(r"[.;!\n]+", " ".join(note.lower().split()))
        found = [wish for sentence in sentences for wish in _read(number, sentence)]
        wishes += found
        if not found:
            answers.append(f"note {number} is not understood: {READS}")
    return tuple(wishes), tuple(answers)


def avoided(wishes: Iterable[Wish]) -> set[str]:
    """Families, and names of moves, that notes speak against; a later note overrides."""
    found: set[str] = set()
    for wish in wishes:
        names = {wish.name} if wish.name else set(EFFECT_MOVES.get(wish.effect, ()))
        found = found | names if wish.avoid else found - names
    return found


def wished_moves(wish: Wish, at: Situation, moves: Sequence[Move]) -> list[Move]:
    """Moves on this trial that bring the effect, the preferred one first."""
    if at.trial.value is None:
        return []
    if wish.effect == "delay":
        # A delay may take a quarter of the shortest record.
        if wish.samples >= 0.25 * min(len(record) for record in at.facts.records):
            return []
        if at.varies("input_delay"):
            # A grey-box searches up to one sample more.
            return [_delay_move(wish.samples, "input_delay", wish.samples + 1.0)]
        if at.recipe.has("delay") and not isinstance(at.recipe.get("delay"), bool):
            # One sample of the delay is that of the state equation.
            return [_delay_move(wish.samples, "delay", max(wish.samples - 1, 0))]
        return []

    def is_worth_making(move: Move) -> bool:
        if move.evidence(at):
            return True
        # The note replaces the evidence that a move to friction requires.
        lacks = wish.effect == "friction" and not at.recipe.get("friction")
        return lacks and bool(move.change(at).get("friction"))

    names = EFFECT_MOVES.get(wish.effect, ())
    found = [m for m in moves if m.name in names and m.applies(at) and is_worth_making(m)]
    return sorted(found, key=lambda move: names.index(move.name))


def wished_start(wish: Wish, row: Family, recipe: Recipe) -> Recipe | None:
    """The first configuration of a family with the effect; None where it has none."""
    if wish.effect == "saturation":
        return recipe if row.name == "block_oriented" else None
    if wish.effect == "friction" and row.name == "neural_ss":
        recipe = recipe.without("channels", "members")
        return recipe.configured(nonlinearity="none", friction=1).trained(starts=4)
    return None


def _read(number: int, sentence: str) -> list[Wish]:
    verbs = [(m.start(), m.lastgroup) for m in _VERBS.finditer(sentence)]

    def verb_before(place: int) -> str | None:
        return next((kind for start, kind in reversed(verbs) if start < place), None)

    found: list[tuple[int, Wish]] = []
    for effect, pattern in _EFFECTS.items():
        for m in pattern.finditer(sentence):
            samples = int(m["n"] or m["m"]) if effect == "delay" else 0
            avoid = verb_before(m.start()) == "avoid" and effect != "delay"
            found.append((m.start(), Wish(number, effect, avoid, samples=samples)))
    rest = sentence
    for name, pattern in _family_patterns():
        for m in pattern.finditer(rest):
            verb = verb_before(m.start())
            alone = not re.sub(r"please|\W", "", sentence.replace(m[0], ""))
            if verb in ("try", "avoid") or (verb is None and alone):
                found.append((m.start(), Wish(number, "family", verb == "avoid", name)))
        rest = pattern.sub(lambda m: "\0" * len(m[0]), rest)
    return [wish for _, wish in sorted(found, key=lambda pair: pair[0])]


@cache
def _family_patterns() -> tuple[tuple[str, re.Pattern[str]], ...]:
    """Names and labels of all families, the longest first."""
    names = [(row.name, text.lower()) for row in all_families() for text in (row.name, row.label)]
    names.sort(key=lambda pair: -len(pair[1]))
    return tuple(
        (name, re.compile(rf"(?<![\w-]){re.sub(r'[-_ ]+', '[-_ ]?', text)}s?(?![\w-])"))
        for name, text in names
    )


def _delay_move(samples: int, setting: str, value: float) -> Move:
    return Move(
        name=f"a delay of {samples} samples",
        evidence=lambda _: SHOWN,
        change=lambda c: c.recipe.configured(**{setting: value}),
        hypothesis=f"The inputs act after {samples} samples.",
        expected="A lower V if the delay is right.",
    )
