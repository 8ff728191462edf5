"""Run the red team on this machine: `python -m tests.redteam` in a checkout.

Exit code 1 if an attack succeeds, if an attack does not succeed even with isolation off, if an
honest candidate is flagged, or if one could not be checked. Attacks run without isolation only in
an outer sandbox.
"""

from __future__ import annotations

import argparse
import json
import signal
import socket
import sys
import time
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from types import FrameType

from asia.errors import UserError
from asia.judge.evaluation.machines import survey_machines
from asia.judge.evaluation.relations import SuspicionKind
from asia.judge.executors import make_executor, remote_executor_of
from asia.judge.sandbox.availability import fitting_levels, why_not
from asia.judge.sandbox.levels import LEVELS
from asia.judge.sandbox.types import Isolation, Layer
from tests.redteam import suite
from tests.redteam.attacks.table import ATTACKS
from tests.redteam.honest import problem_named
from tests.redteam.outside import outer_sandbox
from tests.redteam.problem import Check, Principle
from tests.redteam.types import Attack, CandidateAttack, Finding, HonestFinding, SuspicionFinding

_EACH, _CHECKS = "each", "checks"
_LAYERS = {str(one): one for one in (Layer.LANDLOCK, Layer.SECCOMP, Layer.RLIMITS, Layer.PIDS)}
_CHECK_NAMES: dict[str, Check] = {
    str(kind).replace(" ", "-"): kind for kind in (*SuspicionKind, *Principle)
}


def main(words: Sequence[str] | None = None) -> int:
    """Return the exit code."""
    ask = _parser()
    given = ask.parse_args(words)
    if given.table:
        print(suite.attack_table(ATTACKS))
        return 0
    try:
        with _one_interrupt():
            return _run(given)
    except UserError as error:
        ask.error(str(error))


def _parser() -> argparse.ArgumentParser:
    ask = argparse.ArgumentParser("python -m tests.redteam", description=__doc__)
    ask.add_argument(
        "--table", action="store_true", help="print what each attack tries and what stops it"
    )
    ask.add_argument("--only", type=int, nargs="+", metavar="N", help="attacks by number")
    ask.add_argument("--level", nargs="+", help="default: all that work here except process")
    ask.add_argument(
        "--without",
        nargs="+",
        metavar="LAYER|CHECK",
        help=f"leave layers ({', '.join(_LAYERS)}; '{_EACH}': one after the other) or checks out "
        f"({', '.join(_CHECK_NAMES)}; '{_CHECKS}': those that stop each attack)",
    )
    ask.add_argument(
        "--honest-on",
        nargs="+",
        metavar="PROBLEM",
        help="only the first candidates of all model families on these problems, in full",
    )
    ask.add_argument("--quick", action="store_true", help="each family on one problem, not on two")
    ask.add_argument("--no-prove", action="store_true", help="no attack with isolation off")
    ask.add_argument("--executor", help="executor of the attacks' folds, on this machine")
    ask.add_argument("--json", action="store_true", help="one line of JSON for each result")
    return ask


def _run(given: argparse.Namespace) -> int:
    numbers = [attack.number for attack in ATTACKS]
    for number in given.only or ():
        if number not in numbers:
            raise UserError(f"--only {number}: there are attacks {', '.join(map(str, numbers))}")
    attacks = tuple(a for a in ATTACKS if given.only is None or a.number in given.only)
    names = {attack.number: attack.name for attack in attacks}

    def show(result: Finding | HonestFinding | SuspicionFinding) -> None:
        print(suite.line(result, names), file=sys.stderr, flush=True)
        if given.json:
            print(json.dumps(asdict(result)), flush=True)

    levels = _levels(given.level)
    if given.without:
        print(_run_without(levels, given.without, attacks, show))
        return 0
    honest = () if given.only or given.executor else suite.honest_plan(given.quick)
    if given.honest_on:
        problems = [problem_named(name) for name in given.honest_on]
        honest, attacks = tuple((p, row) for p in problems for row in p.families), ()
    executor = None
    if given.executor:
        # Attacks aim at files and processes of this machine, and are made by candidates.
        executor = make_executor(given.executor)
        remote = remote_executor_of(executor)
        for state in survey_machines(remote) if remote else ():
            if state.machine != socket.gethostname():
                raise UserError(f"worker {state.worker} is not on this machine")
        attacks = tuple(a for a in attacks if isinstance(a, CandidateAttack))
    missing = outer_sandbox.why_no_outer()
    if not given.no_prove and missing is not None:
        print(f"attacks with isolation off are left out: {missing}", file=sys.stderr)
    prove = not given.no_prove and missing is None and bool(attacks)
    begin = time.monotonic()
    report = suite.run_suite(suite.RedTeamPlan(levels, attacks, prove, honest, executor), show)
    if attacks and not given.json:
        print(suite.report_table(report))
        if table := suite.gate_table(levels[:1], attacks):
            print(f"\n{table}\n")
    print(suite.summary(report, time.monotonic() - begin))
    return 0 if report.passed else 1


def _run_without(
    levels: Sequence[Isolation], words: list[str], attacks: Sequence[Attack], show: suite.OnResult
) -> str:
    """Run the attacks without some layers, or without some checks; return the table."""
    if words == [_CHECKS] or all(word in _CHECK_NAMES for word in words):
        kinds = [_CHECK_NAMES[word] for word in words if word != _CHECKS]
        walled = [level for level in levels if LEVELS[level].confined]
        return suite.unchecked_table(suite.without_checks(walled, attacks, kinds, show))
    if words == [_EACH]:
        settings = suite.each_layer(levels)
    elif all(word in _LAYERS for word in words):
        layers = tuple(_LAYERS[word] for word in dict.fromkeys(words))
        settings = tuple((at, layers) for at in levels if {*layers} <= {*LEVELS[at].layers})
    else:
        raise UserError(
            f"--without {' '.join(words)}: expected '{_EACH}', '{_CHECKS}', layers, or checks; "
            "level namespace without namespaces is level landlock"
        )
    return suite.without_table(suite.without_layers(settings, attacks, show))


def _levels(words: list[str] | None) -> tuple[Isolation, ...]:
    fitting = {str(level.isolation): level for level in fitting_levels()}
    if words is None:
        words = [
            n for n, level in fitting.items() if level.confined and why_not(level.isolation) is None
        ]
    for word in words:
        reason = why_not(fitting[word].isolation) if word in fitting else "unknown"
        if reason is not None:
            raise UserError(f"--level {word}: {reason}; expected some of {', '.join(fitting)}")
    if not words:
        raise UserError("no level that confines candidates works here: see `asia doctor`")
    return tuple(fitting[word].isolation for word in dict.fromkeys(words))


@contextmanager
def _one_interrupt() -> Generator[None]:
    """End after the running attack on the first interrupt, and ignore others: they would leave the
    target of the attack behind."""

    def end(number: int, frame: FrameType | None) -> None:
        for one in before:
            signal.signal(one, lambda number, frame: None)
        before.clear()  # the process ends, and a thread may still tidy up after `main`
        print("ending: waiting for the attack that runs", file=sys.stderr, flush=True)
        sys.exit(128 + number)

    before = {one: signal.signal(one, end) for one in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for one, handler in before.items():
            signal.signal(one, handler)


if __name__ == "__main__":
    sys.exit(main())
