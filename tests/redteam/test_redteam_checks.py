"""Each relation matters: what cheats score when those that stop them are left out."""

import re
from dataclasses import replace

import pytest

from asia.judge.sandbox.availability import why_not
from asia.judge.sandbox.types import Isolation
from tests.redteam.arena import attack_candidate
from tests.redteam.attacks.table import ATTACKS
from tests.redteam.problem import Principle
from tests.redteam.suite import unchecked_table, without_checks
from tests.redteam.types import AttackVerdict, CandidateAttack

WORKING = [x for x in (Isolation.NAMESPACE, Isolation.LANDLOCK) if why_not(x) is None]
ONE_LEVEL = WORKING[0] if WORKING else None
CHECKED = [a for a in ATTACKS if isinstance(a, CandidateAttack) and a.checks]
needs_level = pytest.mark.skipif(ONE_LEVEL is None, reason="no level keeps intent in here")


def one_variant(attack: CandidateAttack) -> CandidateAttack:
    name = next(iter(attack.sources))
    return replace(attack, sources={name: attack.sources[name]})


@needs_level
def test_an_attack_succeeds_without_the_checks_that_stop_it_and_not_with_them():
    attack = one_variant(CHECKED[0])
    (found,) = without_checks([ONE_LEVEL], [attack])
    assert found.succeeded
    assert found.value < 0.8 * found.honest
    assert found.without == tuple(map(str, attack.checks))
    assert found.checked.verdict is AttackVerdict.FLAGGED
    words = unchecked_table([replace(found, succeeded=False)])
    assert "DOES NOT SUCCEED" in words
    assert "flagged: look-ahead" in words


STANDARDISED = next(a for a in CHECKED if Principle.FOLD_STATISTICS in a.checks)


@pytest.mark.slow
@needs_level
@pytest.mark.parametrize(
    "variant",
    [
        pytest.param(name, marks=[pytest.mark.long] if number else [])
        for number, name in enumerate(STANDARDISED.sources)
    ],
)
def test_held_out_outputs_cannot_be_inferred_where_each_fit_standardises_its_own_records(variant):
    attack = replace(STANDARDISED, sources={variant: STANDARDISED.sources[variant]})
    (one,) = without_checks([ONE_LEVEL], [attack])
    assert one.succeeded
    assert one.value < 0.8 * one.honest
    # With the principle it answers as the honest candidate does.
    told = re.fullmatch(r".*V (\S+), honest (\S+)", one.checked.note)
    assert told is not None
    assert told[1] == told[2]
    assert one.checked.verdict is AttackVerdict.NO_GAIN


@pytest.mark.long
@needs_level
def test_every_variant_succeeds_without_the_checks_that_stop_it_and_not_with_them():
    found = without_checks(WORKING, CHECKED)
    expected = {(a.number, name, str(x)) for a in CHECKED for name in a.sources for x in WORKING}
    assert {(one.number, one.variant, one.level) for one in found} == expected
    assert [one for one in found if not one.succeeded or one.checked.through] == []


@needs_level
def test_a_look_ahead_is_flagged_where_few_large_errors_hide_its_mean():
    (attack,) = (a for a in ATTACKS if a.number == 27)
    assert isinstance(attack, CandidateAttack)
    found = attack_candidate(attack, ONE_LEVEL)
    assert found.verdict is AttackVerdict.FLAGGED
    assert "look-ahead" in found.note
