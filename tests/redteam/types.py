"""Attacks, observations of them, and findings."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING

from asia.errors import Reason
from tests.redteam.problem import Check, ProblemName

if TYPE_CHECKING:
    from tests.redteam.attacks.searches import Scene


class Barrier(StrEnum):
    """Barrier against an attack."""

    NAMESPACES = "namespaces"
    LANDLOCK = "landlock"
    SECCOMP = "seccomp"
    RLIMITS = "rlimits"
    PIDS = "pids"
    KERNEL = "kernel"
    """Rules of the operating system about users and files."""
    PARENT = "parent"
    """The evaluator's process, which alone computes and checks scores."""
    DEADLINE = "deadline"
    FRESH = "fresh worker"
    READER = "source reader"
    """The process with limits that reads sources before the search does."""
    GUARD = "guard records"
    """Records that nobody in a search can read: a gain that they do not show is unconfirmed."""
    METAMORPHIC = "metamorphic check"
    FEEDBACK = "feedback"
    LEDGER = "ledger"
    PROBLEM = "problem check"
    WORKSPACE = "link outside"
    """The run of a workspace, recorded where no agent writes."""


class Mistake(StrEnum):
    """A mistake that the evaluation without isolation makes for one attack alone: with it, all
    others would succeed by failing."""

    DROPS_FOLDS = "failed folds are left out"
    STARTS_AT_ZERO = "an end without a score counts as 0"
    BELIEVES_CODES = "an exit code of 137 counts as a kill from outside"


class AttackVerdict(StrEnum):
    """Verdict on an attack."""

    BLOCKED = "blocked"
    """The attempt failed."""
    NO_GAIN = "no gain"
    """The attempt worked, but does not improve the score."""
    FLAGGED = "flagged"
    """The candidate was recognised as a cheat and refused."""
    THROUGH = "through"
    """The attack succeeded."""


@dataclass(frozen=True)
class Observed:
    """Observations of one candidate and its traces, from the evaluator's side."""

    value: float | None
    """Score; None for a failure."""
    honest: float
    """The score of the honest candidate it is built on."""
    reason: Reason | None = None
    detail: str = ""
    """The message of its failure."""
    output: str = ""
    """Text that the candidate printed."""
    steps: Mapping[str, str] = field(default_factory=dict[str, str])
    """Result of each attempt as the candidate reports it: `done`, or the name of the error."""
    seconds: float = 0.0
    limit: float = 0.0
    """Time limit of a fit in seconds."""
    unconfirmed: str = ""
    """Gain on the guard records, in words, where it is less than half of that in V."""
    overran: bool = False
    """Whether no deadline ended it."""
    ran: bool = False
    """Whether its code ran in the evaluator."""
    ledger: bool = False
    """Whether it changed a ledger."""
    leaked: bool = False
    """Whether it printed a secret."""
    hurt: str = ""
    """Harm to a neighbouring process."""
    survivors: tuple[str, ...] = ()
    """Processes of it that still run."""
    strays: tuple[str, ...] = ()
    """Files and shared memory that it left."""


Success = Callable[[Observed], bool]
"""Criterion for the success of an attack."""


@dataclass(frozen=True)
class CandidateAttack:
    """A candidate that cheats or breaks out."""

    number: int
    """Number in docs/redteam.md."""
    name: str
    tries: str
    """Description of the attempt, in one sentence."""
    sources: Mapping[str, str]
    """Variants by name, as the text of `candidate.py`."""
    success: Success
    stops: tuple[Barrier, ...]
    problem: ProblemName = "simulation"
    """The small problem that it is tried on."""
    limit: float = 20.0
    """Time limit of a fit in seconds."""
    memory_mb: int = 1024
    folds: int | None = None
    """Number of the problem's folds to evaluate; None for all."""
    at_once: tuple[str, ...] = ()
    """The variants whose folds run at the same time."""
    mistake: Mistake | None = None
    """The mistake of an evaluation without isolation that it needs."""
    checks: tuple[Check, ...] = ()
    """The relations or principles without which all of its variants succeed; () where others stop
    it too."""

    @property
    def walled(self) -> bool:
        """Whether layers of the sandbox have a part in it."""
        layers = {
            Barrier.NAMESPACES,
            Barrier.LANDLOCK,
            Barrier.SECCOMP,
            Barrier.RLIMITS,
            Barrier.PIDS,
        }
        return bool(layers & {*self.stops})


@dataclass(frozen=True)
class SearchAttackResult:
    """Result of an attack on the search itself."""

    succeeded: bool
    """Whether nothing stopped it."""
    stops: tuple[Barrier, ...]
    note: str
    """Course of the attack, in words."""
    flagged: bool = True
    """Whether it was refused as a cheat; False where the attempt failed."""


@dataclass(frozen=True)
class SearchAttack:
    """A cheating agent."""

    number: int
    name: str
    tries: str
    """Description of the attempt, in one sentence."""
    play: Callable[[Scene], SearchAttackResult]
    """The attack on a real search."""
    play_unprotected: Callable[[Path], bool]
    """The same attack, in a scratch folder, on the plainest code that would do; whether it
    succeeded."""
    stops: tuple[Barrier, ...]

    @property
    def walled(self) -> bool:
        """Layers of the sandbox have no part in it."""
        return False


Attack = CandidateAttack | SearchAttack
ANY_LEVEL = "any level"


@dataclass(frozen=True)
class Finding:
    """Finding about one attack in one setting."""

    number: int
    level: str
    """Isolation level, `off`, or `any level` where the sandbox layers do not affect the attack."""
    verdict: AttackVerdict
    stops: tuple[str, ...]
    note: str
    """Course of the attack, in words."""
    without: tuple[str, ...] = ()
    """The layers that were left out."""

    @property
    def through(self) -> bool:
        """Whether nothing stopped it."""
        return self.verdict is AttackVerdict.THROUGH


@dataclass(frozen=True)
class SuspicionFinding:
    """Finding about one variant of an attack with some checks left out, and with all."""

    number: int
    variant: str
    level: str
    without: tuple[str, ...]
    """The relations and principles that were left out."""
    honest: float
    """The score of the honest candidate it is built on."""
    value: float | None
    """Score without these relations; None for a failure."""
    succeeded: bool
    """Whether it succeeded without them."""
    checked: Finding
    """Finding with all relations."""


@dataclass(frozen=True)
class HonestFinding:
    """Finding of the cheat checks for an honest candidate."""

    family: str
    problem: str
    flagged: bool
    """Whether it was mistaken for a cheat."""
    words: str
    """The checks that flagged it, or how it failed."""
    seconds: float
    """Duration of the fit and the checks."""
    failure: Reason | None = None
    """Reason for a missing check; None if it was checked."""
