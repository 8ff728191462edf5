"""What an attack is, what was seen of it, and what that amounts to."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from asia.errors import Reason

if TYPE_CHECKING:
    from asia.redteam.attacks.searches import Scene


class Stop(StrEnum):
    """What stands in an attack's way."""

    NAMESPACES = "namespaces"
    LANDLOCK = "landlock"
    SECCOMP = "seccomp"
    RLIMITS = "rlimits"
    KERNEL = "kernel"  # its ordinary rules about users and files
    PARENT = "parent"  # it alone computes, checks and parses
    DEADLINE = "deadline"
    FRESH = "fresh worker"
    LINT = "lint"
    METAMORPHIC = "metamorphic check"
    FEEDBACK = "feedback"
    LEDGER = "ledger"
    PROBLEM = "problem check"


class Mistake(StrEnum):
    """What an evaluation without isolation does wrong for one attack alone, as others would succeed
    by failing."""

    DROPS_FOLDS = "failed folds are left out"
    STARTS_AT_ZERO = "an end without a score counts as 0"


class Verdict(StrEnum):
    """blocked: what it tried failed. no gain: it did what it tried, and nothing came of it.
    flagged: it was told apart from an honest candidate and refused. through: it succeeded."""

    BLOCKED = "blocked"
    NO_GAIN = "no gain"
    FLAGGED = "flagged"
    THROUGH = "through"


@dataclass(frozen=True)
class Seen:
    """What one candidate left to see, from outside.

    value: its score, None for a failure, whose reason and detail stand beside it; honest: that of
    the honest candidate it is built on; output: what it printed; steps: what it says of each of
    its attempts, `done` or the name of the error; seconds: how long it was judged, of `limit` for a
    fit; overran: whether its judge ended it at no deadline; ran: whether code of its ran in the
    evaluator; ledger: whether it changed one; leaked: whether it printed a secret; hurt: what it
    did to a neighbour.
    """

    value: float | None
    honest: float
    reason: Reason | None = None
    detail: str = ""
    output: str = ""
    steps: Mapping[str, str] = field(default_factory=dict[str, str])
    seconds: float = 0.0
    limit: float = 0.0
    overran: bool = False
    ran: bool = False
    ledger: bool = False
    leaked: bool = False
    hurt: str = ""
    survivors: tuple[str, ...] = ()
    strays: tuple[str, ...] = ()


Won = Callable[[Seen], bool]


@dataclass(frozen=True)
class CandidateAttack:
    """A candidate that cheats or breaks out; `sources` are its variants by name.

    number: that of docs/redteam.md; tries: one sentence; won: how success would be seen; stops:
    what is expected to stop it; kind: simulation of a record, or of windows; limit: seconds a fit
    may take; folds: on how many of the two it is tried; at_once: the variants whose folds run at
    the same time; mistake: that it needs where isolation is off.
    """

    number: int
    name: str
    tries: str
    sources: Mapping[str, str]
    won: Won
    stops: tuple[Stop, ...]
    kind: Literal["simulation", "windows"] = "simulation"
    limit: float = 20.0
    memory_mb: int = 1024
    folds: int = 2
    at_once: tuple[str, ...] = ()
    mistake: Mistake | None = None

    @property
    def walled(self) -> bool:
        """Whether layers of the sandbox have a part in it."""
        return bool({Stop.NAMESPACES, Stop.LANDLOCK, Stop.SECCOMP, Stop.RLIMITS} & {*self.stops})


@dataclass(frozen=True)
class Play:
    """How an attack on the search itself ended: what stopped it, in which words; `won` where
    nothing did."""

    won: bool
    stops: tuple[Stop, ...]
    note: str
    flagged: bool = True


@dataclass(frozen=True)
class SearchAttack:
    """A cheating agent. play: against a real search; naive: the same against the plainest code that
    would do, in a scratch folder, and whether it won."""

    number: int
    name: str
    tries: str
    play: Callable[[Scene], Play]
    naive: Callable[[Path], bool]
    stops: tuple[Stop, ...]

    @property
    def walled(self) -> bool:
        """Layers of the sandbox have no part in it."""
        return False


Attack = CandidateAttack | SearchAttack
ANY_LEVEL = "any level"


@dataclass(frozen=True)
class Finding:
    """What became of one attack in one setting. `level` is a level of isolation, `off`, or
    `any level` where the walls have no part in it; `without` are the layers left out; `note` says
    how it ended."""

    number: int
    level: str
    verdict: Verdict
    stops: tuple[str, ...]
    note: str
    without: tuple[str, ...] = ()

    @property
    def through(self) -> bool:
        """Whether nothing stopped it."""
        return self.verdict is Verdict.THROUGH


@dataclass(frozen=True)
class Honest:
    """An honest candidate under the same checks. flagged: whether it was taken for a cheat; words:
    by which checks, or how it failed; failure: why it came to no check."""

    family: str
    problem: str
    flagged: bool
    words: str
    seconds: float
    failure: Reason | None = None
