"""Plants of the catalogue that a problem looks like, with the reasons.

A word tells the more, the fewer plants of the catalogue have it, by its inverse document frequency
(Spärck Jones, Journal of Documentation 28, 1972). The words of a description that the catalogue
has are compared with those of each plant by naive Bayes: half of them are the plant's own where it
is this plant, and each is by chance otherwise. Findings in the records, seen or missing,
count in the same way. A plant needs a signal for each of its roles, and a role for each output.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from math import exp, log

from asia.data.level_responses import pacing_input
from asia.data.statistics import integrating, limit_shares, resonant
from asia.data.trajectory import Signal, Trajectory
from asia.plants.catalogue import Plant, Role, Sign, catalogue, quantities
from asia.problem.problem import is_described

CLEAR = 1.0
"""Evidence from which a plant is likelier than none, where all plants of the catalogue together are
as likely as none; less is "unknown"."""
MOST_LIKELY = 2
"""Plants that are worth a try."""
MOST_MAPPINGS = 3
"""Assignments of signals to roles that are worth a try."""
_MOST_SIGNALS = 6
_LEAST_LETTERS = 2
_LEAST_STEM = 4
_LEAST_REST = 0.02
_KNOWN = 0.5
"""Share of the words of a description, among those of the catalogue, that the plant's entry has;
and of the records of a plant that show a finding of its entry."""
# Numbers and directions, which any description has.
_PLAIN = frozenset(
    {"two", "three", "four", "first", "second", "third", "fourth", "input", "inputs", "output"}
    | {"outputs", "in", "out"}
)
_ENDINGS = (
    "izations", "ization", "isation", "ations", "ation", "ators", "ating", "ated", "ator", "ates",
    "ions", "ings", "ion", "ing", "ers", "ors", "ized", "ised", "ize", "ise", "ate", "ous", "ive",
    "ity", "ies", "al", "er", "or", "ed", "es", "ly", "e", "s", "y",
)  # fmt: skip
# Units that sensors and actuators of any quantity have.
_ANY = frozenset({"", "V", "mV", "%", "1", "-", "pu", "p.u.", "counts", "std"})


@dataclass(frozen=True)
class Likeness:
    """A plant that a problem looks like."""

    plant: Plant
    score: float
    """Logarithm of how much likelier the words and findings are with this plant than without, over
    that of the number of plants."""
    words: tuple[str, ...]
    """Words of the problem that point at it, the most telling first."""
    signs: tuple[str, ...]
    """Findings in the records that point at it."""
    mappings: tuple[Mapping[str, str], ...]
    """Signals of its roles, the likeliest first."""

    @property
    def looks(self) -> str:
        """Name the plant and the evidence in a sentence."""
        return f"this looks like: {self.plant.title} ({self.reasons})"

    @property
    def reasons(self) -> str:
        """Describe the evidence on one line."""
        return "; ".join((f"words: {', '.join(self.words)}", *self.signs))


def recognise(
    description: str,
    inputs: Sequence[Signal],
    outputs: Sequence[Signal],
    records: Sequence[Trajectory] = (),
) -> tuple[Likeness, ...]:
    """Rank the plants whose roles the signals can fill, the likeliest first.

    Args:
        description: the user's words
        inputs, outputs: signals of the problem
        records: training records; () leaves out what they show
    """
    names = [s.name for s in (*inputs, *outputs)]
    spoken = _words(description) if is_described(description) else {}
    for name in names:
        spoken |= _words(name)
    shown: dict[Sign, str] | None = None
    unit = log(len(catalogue()))
    found: list[Likeness] = []
    for plant in catalogue().values():
        own = _stems()[plant.name]
        told = sorted(spoken.keys() & own, key=lambda stem: (-_rarity()[stem], stem))
        if not told:
            continue
        mappings = assignments(plant, inputs, outputs)
        if not mappings:
            continue
        known = spoken.keys() & _rarity().keys()
        score = sum(_evidence(exp(-_rarity()[one]), has=one in own) for one in known)
        if shown is None:
            shown = _shown(tuple(records), outputs)
        signs: list[str] = []
        for sign in plant.entry.signs:
            if sign not in shown:
                continue
            score += _evidence(_sign_share(sign), has=bool(shown[sign]))
            if shown[sign]:
                signs.append(shown[sign])
        words = tuple(spoken[stem] for stem in told if _rarity()[stem] > 0)
        found.append(Likeness(plant, score / unit, words, tuple(signs), mappings))
    return tuple(sorted(found, key=lambda one: (-one.score, one.plant.name)))


def likely(ranked: Sequence[Likeness]) -> tuple[Likeness, ...]:
    """Return at most two of the ranked plants: those that are likelier than none, and of which the
    best is not as many times likelier as there are plants; () is "unknown"."""
    least = max([CLEAR, *(one.score - CLEAR for one in ranked[:1])])
    return tuple(one for one in ranked[:MOST_LIKELY] if one.score >= least)


def recognition_lines(ranked: Sequence[Likeness]) -> list[str]:
    """Say which plants a problem looks like, one a line."""
    found = likely(ranked)
    if not found:
        near = f"; nearest: {ranked[0].plant.title}" if ranked else ""
        return [f"plant    unknown to the catalogue{near}"]
    return [f"plant    {one.looks}; --like {one.plant.name}" for one in found]


# Words.


def _words(text: str) -> dict[str, str]:
    """Words of a text by their stems; names of signals are cut at capitals and digits."""
    text = re.sub(r"(?<=[a-z])(?=[A-Z])|_", " ", text)
    found = re.findall(r"[^\W\d_]+", text.lower())
    long = (word for word in found if len(word) >= _LEAST_LETTERS)
    return {stem(word): word for word in long if word not in _PLAIN}


@cache
def stem(word: str) -> str:
    """Remove the endings of a word: heated, heater and heating are one."""
    for ending in _ENDINGS:
        if word.endswith(ending) and len(word) - len(ending) >= _LEAST_STEM:
            word = word.removesuffix(ending)
            break
    return word[:-1] if len(word) > _LEAST_STEM and word[-1] == word[-2] else word


@cache
def _stems() -> Mapping[str, frozenset[str]]:
    """Stems of the words of each plant."""
    found: dict[str, frozenset[str]] = {}
    for name, plant in catalogue().items():
        entry = plant.entry
        roles = (*entry.inputs.values(), *entry.outputs.values())
        words = (*entry.words, *(word for role in roles for word in role.words))
        found[name] = frozenset(_words(" ".join(words)))
    return found


@cache
def _rarity() -> Mapping[str, float]:
    counts = Counter(one for stems in _stems().values() for one in stems)
    return {one: log(len(_stems()) / count) for one, count in counts.items()}


def _evidence(share: float, *, has: bool) -> float:
    """Logarithm of how much likelier a word or finding is with a plant than without, from the share
    of the plants that have it."""
    return log(_KNOWN / share) if has else log((1 - _KNOWN) / (1 - share))


# Records.


@cache
def _sign_share(sign: Sign) -> float:
    plants = catalogue().values()
    return sum(sign in plant.entry.signs for plant in plants) / len(plants)


def _shown(records: tuple[Trajectory, ...], outputs: Sequence[Signal]) -> dict[Sign, str]:
    """Finding in the records for each sign, in words; "" where a sign is missing."""
    if not records:
        return {}
    drifting = ", ".join(outputs[k].name for k in integrating(records))
    pipe = pacing_input(records)
    limits = limit_shares(records)
    resting = [o.name for o, one in zip(outputs, limits, strict=True) if max(one) > _LEAST_REST]
    return {
        "integrates": f"{drifting} integrates" if drifting else "",
        "resonates": "lightly damped mode" if resonant(records) else "",
        "transport": "the delay varies with an input" if pipe is not None else "",
        "limit": f"{', '.join(resting)} rests at a limit" if resting else "",
    }


# Signals and roles.


_Scored = tuple[float, dict[str, str]]


def assignments(
    plant: Plant, inputs: Sequence[Signal], outputs: Sequence[Signal]
) -> tuple[Mapping[str, str], ...]:
    """Signals by role in the likeliest assignments; () where the signals cannot fill the roles."""
    entry = plant.entry
    if max(len(inputs), len(outputs)) > _MOST_SIGNALS:
        return ()
    ins = list(_assigned(entry.inputs, inputs, all_signals=False))
    outs = list(_assigned(entry.outputs, outputs, all_signals=True))
    both = [((a + b, len(one)), {**one, **two}) for a, one in ins for b, two in outs]
    both.sort(key=lambda pair: pair[0], reverse=True)
    # Those that the names do not tell apart from the best are worth a try.
    return tuple(one for total, one in both if total == both[0][0])[:MOST_MAPPINGS]


def _assigned(
    roles: Mapping[str, Role], signals: Sequence[Signal], *, all_signals: bool
) -> Iterator[_Scored]:
    """Assignments with their scores.

    Args:
        all_signals: whether every signal needs a role
    """
    needed = {n for n, r in roles.items() if r.absent is None and not r.optional}

    def extended(free: Sequence[Signal], left: tuple[str, ...]) -> Iterator[_Scored]:
        if not free:
            if not needed & set(left):
                yield 0.0, {}
            return
        for role in left:
            fit = _fit(roles[role], free[0])
            if fit is not None:
                for score, one in extended(free[1:], tuple(r for r in left if r != role)):
                    yield fit + score, {role: free[0].name, **one}
        if not all_signals:
            yield from extended(free[1:], left)

    if len(needed) <= len(signals) and (len(signals) <= len(roles) or not all_signals):
        yield from extended(signals, tuple(roles))


def _fit(role: Role, signal: Signal) -> float | None:
    """How many words of the signal's name are those of the role, and whether its unit is; None
    for a unit of another quantity."""
    unit = signal.unit.strip()
    known = unit in quantities()[role.quantity]
    if not known and unit not in _ANY:
        return None
    text = re.sub(r"(?<=[a-z])(?=[A-Z])|_", " ", signal.name).lower()
    words = set(re.findall(r"[^\W_]+", text))
    words |= {re.sub(r"\d+$", "", word) for word in words}
    own = {word.lower() for word in role.words}
    stems = {stem(word) for word in own}
    return sum(1.0 for word in words if word and (word in own or stem(word) in stems)) + known
