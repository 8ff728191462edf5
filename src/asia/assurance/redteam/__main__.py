"""Program inside the outer sandbox: `python -m asia.assurance.redteam`.

Arguments: `off`, `control` (broken candidates, with isolation off) or a level, then the layers to
leave out, and the attacks' numbers. It prints one finding a line.
"""

from __future__ import annotations

import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from asia.assurance.redteam.arena import attack_candidate
from asia.assurance.redteam.attacks.table import ATTACKS
from asia.assurance.redteam.outside.outer_sandbox import write_finding
from asia.assurance.redteam.outside.without_isolation import (
    CONTROL,
    OFF,
    attack_without_isolation,
    broken,
)
from asia.assurance.redteam.types import Attack, AttackVerdict, CandidateAttack, Finding
from asia.judge.sandbox.types import Isolation, Layer


def main(arguments: list[str]) -> None:
    level, layers, *numbers = arguments
    without = [Layer(word) for word in layers.split(",") if word]
    for attack in ATTACKS:
        if str(attack.number) not in numbers:
            continue
        print(write_finding(_finding(attack, level, without)), flush=True)


def _finding(attack: Attack, level: str, without: list[Layer]) -> Finding:
    if level == OFF:
        return _unprotected_finding(attack)
    assert isinstance(attack, CandidateAttack)
    if level == CONTROL:
        return attack_without_isolation(broken(attack))
    return attack_candidate(attack, Isolation(level), without)


def _unprotected_finding(attack: Attack) -> Finding:
    if isinstance(attack, CandidateAttack):
        return attack_without_isolation(attack)
    with TemporaryDirectory() as folder:
        succeeded = attack.play_unprotected(Path(folder))
    verdict = AttackVerdict.THROUGH if succeeded else AttackVerdict.BLOCKED
    return Finding(attack.number, OFF, verdict, (), "")


if __name__ == "__main__":
    main(sys.argv[1:])
