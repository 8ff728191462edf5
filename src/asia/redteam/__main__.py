"""What runs inside the outer sandbox: `python -m asia.redteam off` or a level and the layers to
leave out, then the attacks' numbers; one finding a line."""

from __future__ import annotations

import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from asia.redteam._arena import attack_candidate
from asia.redteam._attacks import ATTACKS
from asia.redteam._off import OFF, attack_without_isolation
from asia.redteam._outer import write_finding
from asia.redteam._types import Attack, CandidateAttack, Finding, Verdict
from asia.sandbox import Isolation, Layer


def main(arguments: list[str]) -> None:
    level, layers, *numbers = arguments
    without = [Layer(word) for word in layers.split(",") if word]
    for attack in ATTACKS:
        if str(attack.number) not in numbers:
            continue
        finding = _off(attack) if level == OFF else _thin(attack, Isolation(level), without)
        print(write_finding(finding), flush=True)


def _off(attack: Attack) -> Finding:
    if isinstance(attack, CandidateAttack):
        return attack_without_isolation(attack)
    with TemporaryDirectory() as folder:
        won = attack.naive(Path(folder))
    verdict = Verdict.THROUGH if won else Verdict.BLOCKED
    return Finding(attack.number, OFF, verdict, (), "")


def _thin(attack: Attack, level: Isolation, without: list[Layer]) -> Finding:
    assert isinstance(attack, CandidateAttack)
    return attack_candidate(attack, level, without)


if __name__ == "__main__":
    main(sys.argv[1:])
