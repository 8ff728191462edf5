"""A cheat is refused alike whoever submits it: an agent in this process, `asia try` in a workspace,
a client of the MCP server, or an agent whose folds are fitted by a Dask cluster."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import pytest

from asia.errors import Reason
from asia.judge.sandbox.availability import fitting_levels, why_not
from tests.redteam.attacks.searches import RERUNS
from tests.redteam.attacks.table import ATTACKS
from tests.redteam.interfaces import Interface, search_with
from tests.redteam.problem import small_problem
from tests.redteam.types import CandidateAttack

LEVELS = [x.isolation for x in fitting_levels() if x.confined and why_not(x.isolation) is None]
pytestmark = pytest.mark.skipif(not LEVELS, reason="no level keeps intent in here")


@dataclass(frozen=True)
class Cheat:
    """One variant of an attack, and what refuses it; no reason where it answers as the honest
    candidate does."""

    number: int
    variant: str
    reason: Reason | None = None
    words: str = ""

    @property
    def attack(self) -> CandidateAttack:
        found = next(a for a in ATTACKS if a.number == self.number)
        assert isinstance(found, CandidateAttack)
        return found


CHEATS = [
    Cheat(51, "mean and spread"),
    Cheat(55, "without memory", Reason.SUSPECT, "look-ahead: "),
]
INTERFACES = (Interface.WORKSPACE, Interface.MCP, Interface.LOCAL, Interface.DASK)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("cheat", "interface"),
    [
        # Every interface and every cheat once; the other pairs before a release.
        pytest.param(cheat, interface, marks=[] if j % len(CHEATS) == i else [pytest.mark.long])
        for i, cheat in enumerate(CHEATS)
        for j, interface in enumerate(INTERFACES)
    ],
    ids=lambda one: one.attack.name if isinstance(one, Cheat) else str(one),
)
def test_a_cheat_is_refused_by_every_interface(
    cheat: Cheat, interface: Interface, tmp_path: Path
) -> None:
    problem = small_problem(cheat.attack.problem)
    view = search_with([cheat.attack.sources[cheat.variant]], interface, tmp_path, problem)
    assert view.started.isolation == LEVELS[0]
    honest, cheating = view.experiments
    assert honest.score is not None
    assert view.best is honest
    if cheat.reason is None:
        assert cheating.score == honest.score
    else:
        assert cheating.failure is not None
        assert cheating.failure.reason is cheat.reason
        assert cheat.words in cheating.failure.detail


@pytest.mark.slow
@pytest.mark.parametrize(
    "interface",
    [
        Interface.LOCAL,
        Interface.MCP,
        pytest.param(Interface.WORKSPACE, marks=pytest.mark.long),
        pytest.param(Interface.DASK, marks=pytest.mark.long),
    ],
)
def test_the_same_candidate_in_other_clothes_gets_the_same_draw(
    interface: Interface, tmp_path: Path
) -> None:
    view = search_with(RERUNS, interface, tmp_path, guard=False)
    # A workspace and the MCP server answer a candidate that they know without an experiment.
    _, first, *again = view.finished
    assert {e.score for e in again} <= {first.score}
    assert [e.result.duplicate_of for e in again if e.result] == [first.number] * len(again)
