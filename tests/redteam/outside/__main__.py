"""Program inside the outer sandbox: `python -m tests.redteam.outside`.

Arguments: `off`, `control` (broken candidates, with isolation off) or a level, then the layers to
leave out, and the attacks' numbers. It prints one finding a line.
"""

import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from asia.judge.sandbox.types import Isolation, Layer
from tests.redteam.arena import attack_candidate
from tests.redteam.attacks.doctor import DOCTOR
from tests.redteam.attacks.table import ATTACKS
from tests.redteam.outside.outer_sandbox import write_finding
from tests.redteam.outside.without_isolation import (
    CONTROL,
    OFF,
    attack_without_isolation,
    broken,
)
from tests.redteam.types import AttackVerdict, CandidateAttack, Finding


def main(arguments: list[str]) -> None:
    level, layers, *numbers = arguments
    without = [Layer(word) for word in layers.split(",") if word]
    for attack in (*ATTACKS, *DOCTOR):
        if str(attack.number) not in numbers:
            continue
        if level == OFF and not isinstance(attack, CandidateAttack):
            with TemporaryDirectory() as folder:
                succeeded = attack.play_unprotected(Path(folder))
            verdict = AttackVerdict.THROUGH if succeeded else AttackVerdict.BLOCKED
            finding = Finding(attack.number, OFF, verdict, (), "")
        else:
            assert isinstance(attack, CandidateAttack)
            if level == OFF:
                finding = attack_without_isolation(attack)
            elif level == CONTROL:
                finding = attack_without_isolation(broken(attack))
            else:
                finding = attack_candidate(attack, Isolation(level), without)
        print(write_finding(finding), flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
