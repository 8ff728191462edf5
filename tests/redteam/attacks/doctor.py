"""Attacks of `asia doctor --attack`, to see that each succeeds with isolation off."""

from asia.testing.attacks import ATTACKS, SUCCEEDED
from tests.redteam.evidence import scores_better
from tests.redteam.types import CandidateAttack

DOCTOR = tuple(
    CandidateAttack(
        number,
        attack.name,
        attack.name,
        # The targets have other names there.
        {"": attack.source.replace("GIVEN", "dict(GIVEN, FOLDER=GIVEN['PLAYGROUND'])")},
        lambda seen: SUCCEEDED in seen.output or scores_better(seen),
        (),
        limit=attack.fit_seconds if attack.ends is None else 5.0,
    )
    for number, attack in enumerate(ATTACKS, 1001)
)
