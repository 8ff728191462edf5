"""Attacks, what is observed of them, and what became of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING

from asia.errors import Reason
from asia.evaluation import SuspicionKind
from asia.redteam._problem import ProblemName

if TYPE_CHECKING:
    from asia.redteam.attacks.searches import Scene


class Barrier(StrEnum):
    """What stands in an attack's way."""

    NAMESPACES = "namespaces"
    LANDLOCK = "landlock"
    SECCOMP = "seccomp"
    RLIMITS = "rlimits"
    KERNEL = "kernel"
    """Its ordinary rules about users and files."""
    PARENT = "parent"
    """The evaluator's process, which alone computes and checks scores."""
    DEADLINE = "deadline"
    FRESH = "fresh worker"
    LINT = "lint"
    METAMORPHIC = "metamorphic check"
    FEEDBACK = "feedback"
    LEDGER = "ledger"
    PROBLEM = "problem check"


class Mistake(StrEnum):
    """A mistake that the evaluation without isolation makes for one attack alone: with it, all
    others would succeed by failing."""

    DROPS_FOLDS = "failed folds are left out"
    STARTS_AT_ZERO = "an end without a score counts as 0"
    BELIEVES_CODES = "an exit code of 137 counts as a kill from outside"


class AttackVerdict(StrEnum):
    """What became of an attack."""

    BLOCKED = "blocked"
    """What it tried failed."""
    NO_GAIN = "no gain"
    """It did what it tried, and its score is no better for it."""
    FLAGGED = "flagged"
    """It was recognised as a cheat and refused."""
    THROUGH = "through"
    """It succeeded."""


@dataclass(frozen=True)
class Observed:
    """What the evaluator's side sees of one candidate and of what it left behind."""

    value: float | None
    """Its score; None for a failure."""
    honest: float
    """The score of the honest candidate it is built on."""
    reason: Reason | None = None
    """Why it failed, if it did."""
    detail: str = ""
    """The message of its failure."""
    output: str = ""
    """What it printed."""
    steps: Mapping[str, str] = field(default_factory=dict[str, str])
    """What it reports of each of its attempts: `done`, or the name of the error."""
    seconds: float = 0.0
    """How long its evaluation took."""
    limit: float = 0.0
    """How many seconds a fit may take."""
    overran: bool = False
    """Whether no deadline ended it."""
    ran: bool = False
    """Whether its code ran in the evaluator."""
    ledger: bool = False
    """Whether it changed a ledger."""
    leaked: bool = False
    """Whether it printed a secret."""
    hurt: str = ""
    """What it did to a neighbouring process."""
    survivors: tuple[str, ...] = ()
    """Processes of it that still run."""
    strays: tuple[str, ...] = ()
    """Files and shared memory that it left."""


Success = Callable[[Observed], bool]
"""How the success of an attack would be seen."""


@dataclass(frozen=True)
class CandidateAttack:
    """A candidate that cheats or breaks out."""

    number: int
    """Its number in docs/redteam.md."""
    name: str
    """What it does, in a few words."""
    tries: str
    """What it tries, in one sentence."""
    sources: Mapping[str, str]
    """Its variants by name, as the text of `candidate.py`."""
    success: Success
    """How its success would be seen."""
    stops: tuple[Barrier, ...]
    """What is expected to stop it."""
    problem: ProblemName = "simulation"
    """The small problem that it is tried on."""
    limit: float = 20.0
    """How many seconds a fit may take."""
    memory_mb: int = 1024
    """Its memory."""
    folds: int | None = None
    """On how many of the problem's folds it is tried; None for all."""
    at_once: tuple[str, ...] = ()
    """The variants whose folds run at the same time."""
    mistake: Mistake | None = None
    """The mistake of an evaluation without isolation that it needs."""
    checks: tuple[SuspicionKind, ...] = ()
    """The relations without which all of its variants succeed; () where others stop it too."""

    @property
    def walled(self) -> bool:
        """Whether layers of the sandbox have a part in it."""
        layers = {Barrier.NAMESPACES, Barrier.LANDLOCK, Barrier.SECCOMP, Barrier.RLIMITS}
        return bool(layers & {*self.stops})


@dataclass(frozen=True)
class SearchAttackResult:
    """How an attack on the search itself ended."""

    succeeded: bool
    """Whether nothing stopped it."""
    stops: tuple[Barrier, ...]
    """What stopped it."""
    note: str
    """How it ended, in words."""
    flagged: bool = True
    """Whether it was refused as a cheat; False where what it tried failed."""


@dataclass(frozen=True)
class SearchAttack:
    """A cheating agent."""

    number: int
    """Its number in docs/redteam.md."""
    name: str
    """What it does, in a few words."""
    tries: str
    """What it tries, in one sentence."""
    play: Callable[[Scene], SearchAttackResult]
    """The attack on a real search."""
    play_unprotected: Callable[[Path], bool]
    """The same attack, in a scratch folder, on the plainest code that would do; whether it
    succeeded."""
    stops: tuple[Barrier, ...]
    """What is expected to stop it."""

    @property
    def walled(self) -> bool:
        """Layers of the sandbox have no part in it."""
        return False


Attack = CandidateAttack | SearchAttack
ANY_LEVEL = "any level"


@dataclass(frozen=True)
class Finding:
    """What became of one attack in one setting."""

    number: int
    """The number of the attack."""
    level: str
    """A level of isolation, `off`, or `any level` where the walls have no part in the attack."""
    verdict: AttackVerdict
    """Whether it succeeded, and what became of it if it did not."""
    stops: tuple[str, ...]
    """What stopped it."""
    note: str
    """How it ended, in words."""
    without: tuple[str, ...] = ()
    """The layers that were left out."""

    @property
    def through(self) -> bool:
        """Whether nothing stopped it."""
        return self.verdict is AttackVerdict.THROUGH


@dataclass(frozen=True)
class SuspicionFinding:
    """What became of one variant of an attack with some relations left out, and with all."""

    number: int
    """The number of the attack."""
    variant: str
    """The name of the variant."""
    level: str
    """The level of isolation."""
    without: tuple[str, ...]
    """The relations that were left out."""
    honest: float
    """The score of the honest candidate it is built on."""
    value: float | None
    """Its score without these relations; None for a failure."""
    succeeded: bool
    """Whether it succeeded without them."""
    checked: Finding
    """What became of it with all relations."""


@dataclass(frozen=True)
class HonestFinding:
    """What the checks that flag cheats make of an honest candidate."""

    family: str
    """The family of its model."""
    problem: str
    """The name of the problem it was fitted to."""
    flagged: bool
    """Whether it was mistaken for a cheat."""
    words: str
    """The checks that flagged it, or how it failed."""
    seconds: float
    """How long the fit and the checks took."""
    failure: Reason | None = None
    """Why it was not checked; None if it was."""
