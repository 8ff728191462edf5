"""Attacks with isolation off, inside an outer sandbox: do they really work?"""

from __future__ import annotations

import contextlib
import re
import subprocess
import sys
import tempfile
import time
from functools import cache
from pathlib import Path

from asia.redteam._problem import Kind, small_problem
from asia.redteam._source import HONEST, fill_in
from asia.redteam._targets import Targets, targets
from asia.redteam._types import CandidateAttack, Finding, Seen
from asia.redteam._verdict import conclude, said_steps, worst_of
from asia.sandbox import Layer

OFF = "off"
_LONGEST_SECONDS = 15.0
_PATIENCE_SECONDS = 2.0
_SAID = re.compile(r"METRIC nrmse=(\S+)")
_NO_LAYERS: tuple[Layer, ...] = ()


def attack_without_isolation(attack: CandidateAttack) -> Finding:
    """Whether one variant at least succeeds. Runs the attack's code for real: to be called inside
    an outer sandbox only."""
    found: list[Finding] = []
    for name, source in attack.sources.items():
        with targets(attack.memory_mb) as given:
            seen = _see(source, attack.kind, given, attack.limit)
            found.append(conclude(attack, name, seen, _NO_LAYERS))
        if found[-1].through:
            break
    return worst_of(found, attack.number, OFF)


@cache
def _honest(kind: Kind) -> float:
    with targets(0) as given:
        value = _see(HONEST, kind, given, _LONGEST_SECONDS, honest=0.0).value
    assert value is not None
    return value


def _see(
    source: str, kind: Kind, given: Targets, limit: float, honest: float | None = None
) -> Seen:
    honest = _honest(kind) if honest is None else honest
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        place = Path(folder, "candidate.py")
        place.write_text(fill_in(source, given.told, small_problem(kind)))
        begin = time.monotonic()
        output, detail = _judge(
            folder, [str(place), kind], min(limit + _PATIENCE_SECONDS, _LONGEST_SECONDS)
        )
        seconds = time.monotonic() - begin
        _judge(folder, ["after"], _LONGEST_SECONDS)
    said = _SAID.search(output)
    survivors = given.survivors()
    return Seen(
        value=_number(said[1]) if said else 0.0,  # an evaluator that starts from 0
        honest=honest,
        detail=detail,
        output=output,
        steps=said_steps(output),
        seconds=seconds,
        limit=limit,
        ran=given.ran,
        ledger=given.ledger_changed,
        leaked=given.secret in output,
        hurt=given.hurt,
        survivors=survivors,
        strays=given.strays(),
    )


def _judge(folder: str, arguments: list[str], seconds: float) -> tuple[str, str]:
    """What the gullible evaluator printed and complained of."""
    command = [sys.executable, "-B", "-m", "asia.redteam._gullible", *arguments]
    with (
        open(Path(folder, ".out"), "w+", errors="replace") as out,
        open(Path(folder, ".err"), "w+", errors="replace") as err,
    ):
        process = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=out, stderr=err, cwd=folder
        )
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(seconds)
        process.kill()
        process.wait()
        out.seek(0)
        err.seek(0)
        return out.read(), err.read()


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return 0.0
