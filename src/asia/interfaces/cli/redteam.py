"""asia doctor --attack: run attacks against this installation."""

from __future__ import annotations

import json as jsonlib
import signal
import sys
import time
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import partial
from types import FrameType
from typing import TYPE_CHECKING, Annotated

import typer

from asia._text import say, say_lines
from asia.errors import UserError

if TYPE_CHECKING:
    from asia.assurance.redteam.suite import RedTeamPlan
    from asia.assurance.redteam.types import Attack, Finding, HonestFinding, SuspicionFinding
    from asia.judge.evaluation.relations import SuspicionKind
    from asia.judge.executors import Executor
    from asia.judge.sandbox.types import Isolation, Layer

LISTS = ("--level", "--only", "--without", "--honest-on")
EACH, CHECKS = "each", "checks"
_option = partial(typer.Option, rich_help_panel="Attacks (--attack)")


@dataclass(frozen=True)
class AttackOptions:
    """Options of the attacks that `asia doctor --attack` runs."""

    level: Annotated[
        list[str] | None,
        _option(
            metavar="LEVEL ...",
            help="Some of namespace, landlock, process; default: all that work here except "
            "process.",
        ),
    ] = None
    only: Annotated[
        list[int] | None,
        _option(
            metavar="N ...",
            help="Attacks by number; default: all, and the honest candidates.",
        ),
    ] = None
    without: Annotated[
        list[str] | None,
        _option(
            metavar="LAYER|CHECK ...",
            help="Show which attacks succeed without some layers (landlock, seccomp, rlimits; "
            "'each': one layer after the other) or without some checks (causality, strangers, "
            "block-end, ...; 'checks': each attack without the checks that stop it).",
        ),
    ] = None
    honest_on: Annotated[
        list[str] | None,
        _option(
            metavar="PROBLEM ...",
            help="Run only the first candidates of all model families on these problems, in "
            "full; takes long.",
        ),
    ] = None
    quick: Annotated[
        bool, _option("--quick", help="Try each honest model family on one problem, not on two.")
    ] = False
    prove: Annotated[
        bool,
        _option(help="Also show that the attacks work with isolation off (needs bubblewrap)."),
    ] = True


def run_attacks(options: AttackOptions, executor: str | None, *, json: bool) -> None:
    """Run scripted attacks against this installation: each must be blocked or flagged, and honest
    candidates must not be.

    Attacks run without isolation only in an outer sandbox. Exit code 1 if an attack succeeds, if an
    attack does not succeed even with isolation off, or if an honest candidate could not be checked.
    executor: workers of this machine that fit the folds of the attacks.
    """
    level, attack, without = options.level, options.only, options.without
    honest_on, quick, prove = options.honest_on, options.quick, options.prove
    chosen = _attacks(attack)
    if without:
        others = (
            ("--quick", quick), ("--honest-on", honest_on), ("--no-prove", not prove),
            ("--executor", executor),
        )  # fmt: skip
        _refuse("--without", others, "plays attacks alone, in an outer sandbox")
        if _names_checks(without):
            _show_unchecked(_levels(level), without, chosen, attack is not None, json)
        else:
            _show_without(_levels(level), without, chosen, attack is not None, json)
        return
    if honest_on:
        others = (("--only", attack), ("--quick", quick), ("--executor", executor))
        _refuse("--honest-on", others, "tries every family on its problems, and no attack")
    elif attack:
        _refuse("--only", (("--quick", quick),), "leaves the honest candidates out")
    elif executor:
        _refuse("--executor", (("--quick", quick),), "leaves the honest candidates out")
    from asia.assurance.redteam.honest import problem_named
    from asia.assurance.redteam.outside.outer_sandbox import why_no_outer
    from asia.assurance.redteam.suite import RedTeamPlan, honest_plan

    levels = _levels(level)
    missing = why_no_outer()
    if prove and missing is not None:
        say(f"attacks with isolation off are left out: {missing}", file=sys.stderr)
    honest = honest_plan(quick) if attack is None and executor is None else ()
    engine = None if executor is None else _engine(executor)
    chosen = chosen if engine is None else _of_candidates(chosen, attack is not None)
    if honest_on:
        problems = [problem_named(name) for name in honest_on]
        honest, chosen = tuple((p, row) for p in problems for row in p.families), ()
    proven = prove and missing is None and bool(chosen)
    _run(RedTeamPlan(levels, chosen, proven, honest, engine), json)


def _run(plan: RedTeamPlan, json: bool) -> None:
    from asia.assurance.redteam.suite import report_table, run_suite, summary

    begin, names = time.monotonic(), {a.number: a.name for a in plan.attacks}
    with _one_interrupt():
        report = run_suite(plan, lambda result: _print_result(result, names, json))
    if json:
        counts = {
            "attacks": len(plan.attacks),
            "stopped": report.stopped,
            "proven": report.proven,
            "honest": len(report.honest),
            "checked": len(report.honest) - len(report.unchecked),
            "false_alarms": report.false_alarms,
        }
        say(jsonlib.dumps({"summary": counts}))
    elif plan.attacks:
        say_lines(report_table(report))
    say_lines(summary(report, time.monotonic() - begin), file=sys.stderr if json else sys.stdout)
    if not report.passed:
        raise typer.Exit(1)


def _show_without(
    levels: tuple[Isolation, ...],
    words: list[str],
    attacks: tuple[Attack, ...],
    named: bool,
    json: bool,
) -> None:
    from asia.assurance.redteam.suite import each_layer, without_layers, without_table
    from asia.judge.sandbox.levels import LEVELS

    if words == [EACH]:
        settings = each_layer(levels)
    else:
        layers = _layers(words)
        settings = tuple((at, layers) for at in levels if {*layers} <= {*LEVELS[at].layers})
    if not settings:
        raise UserError(f"--without {' '.join(words)}: no level asked for has these layers")
    open_field = ", ".join(str(attack.number) for attack in attacks if not attack.walled)
    if named and open_field:
        raise UserError(
            f"no layer has a part in attack {open_field}: leave it out of --only, or leave "
            "--without out"
        )
    names = {attack.number: attack.name for attack in attacks}
    with _one_interrupt():
        found = without_layers(settings, attacks, lambda result: _print_result(result, names, json))
    if not json:
        say_lines(without_table(found, attacks))


def _show_unchecked(
    levels: tuple[Isolation, ...],
    words: list[str],
    attacks: tuple[Attack, ...],
    named: bool,
    json: bool,
) -> None:
    from asia.assurance.redteam.suite import unchecked_table, without_checks
    from asia.assurance.redteam.types import CandidateAttack
    from asia.judge.sandbox.levels import LEVELS

    for level in levels:
        if not LEVELS[level].confined:
            raise UserError(
                f"--without {' '.join(words)}: attacks do not run at level {level}, which confines "
                "nothing; leave --level out"
            )
    kinds = [] if words == [CHECKS] else [_check_names()[word] for word in words]
    concerned = [
        attack
        for attack in attacks
        if isinstance(attack, CandidateAttack) and {*attack.checks} & {*(kinds or attack.checks)}
    ]
    left = ", ".join(str(attack.number) for attack in attacks if attack not in concerned)
    if not concerned or (named and left):
        raise UserError(
            f"--without {' '.join(words)}: these checks have no part in attack {left}: leave it "
            "out of --only, or leave --without out"
        )
    names = {attack.number: attack.name for attack in attacks}
    with _one_interrupt():
        found = without_checks(
            levels, concerned, kinds, lambda result: _print_result(result, names, json)
        )
    if not json:
        say_lines(unchecked_table(found))


def _names_checks(words: list[str]) -> bool:
    """Tell whether the words name checks and not layers. Raises UserError if both are named."""
    checks = [word in _check_names() or word == CHECKS for word in words]
    if any(checks) and (not all(checks) or (CHECKS in words and len(words) > 1)):
        raise UserError(
            f"--without {' '.join(words)}: name layers, or checks, or one of {EACH} and {CHECKS}"
        )
    return all(checks)


def _check_names() -> dict[str, SuspicionKind]:
    from asia.judge.evaluation.relations import SuspicionKind

    return {str(kind).replace(" ", "-"): kind for kind in SuspicionKind}


def _refuse(option: str, others: Sequence[tuple[str, object]], why: str) -> None:
    for name, given in others:
        if given:
            raise UserError(f"{option} and {name} do not go together: {option} {why}")


@contextmanager
def _one_interrupt() -> Generator[None]:
    """End after the running attack on the first interrupt, and ignore others: they would leave the
    target of the attack behind."""

    def end(number: int, frame: FrameType | None) -> None:
        for one in before:
            signal.signal(one, lambda number, frame: None)
        say("ending: waiting for the attack that runs", file=sys.stderr, flush=True)
        sys.exit(128 + number)

    before = {one: signal.signal(one, end) for one in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for one, handler in before.items():
            signal.signal(one, handler)


def _print_result(
    result: Finding | HonestFinding | SuspicionFinding, names: dict[int, str], json: bool
) -> None:
    from asia.assurance.redteam.suite import line

    say(line(result, names), file=sys.stderr, flush=True)
    if json:
        say(jsonlib.dumps(asdict(result)), flush=True)


def _attacks(numbers: list[int] | None) -> tuple[Attack, ...]:
    from asia.assurance.redteam.attacks.table import ATTACKS

    known = {attack.number for attack in ATTACKS}
    for number in numbers or ():
        if number not in known:
            raise UserError(f"--only {number}: there are attacks 1 to {max(known)}")
    return tuple(a for a in ATTACKS if numbers is None or a.number in numbers)


def _engine(name: str) -> Executor:
    """Make the executor. Raises UserError if a worker is on another machine: attacks aim at files
    and processes of this one."""
    import socket

    from asia.judge.evaluation.machines import survey_machines
    from asia.judge.executors import make_executor, remote_executor_of

    found = make_executor(name)
    carrier = remote_executor_of(found)
    for state in survey_machines(carrier) if carrier else ():
        if state.machine != socket.gethostname():
            raise UserError(
                f"--executor {name}: worker {state.worker} is on {state.machine}, and attacks aim "
                "at this machine; run asia doctor --attack there, without --executor"
            )
    return found


def _of_candidates(attacks: tuple[Attack, ...], named: bool) -> tuple[Attack, ...]:
    """Return the attacks made by candidates. Raises UserError if others are requested by number."""
    from asia.assurance.redteam.types import CandidateAttack

    left = ", ".join(str(a.number) for a in attacks if not isinstance(a, CandidateAttack))
    if named and left:
        raise UserError(
            f"--executor has no part in attack {left}, which an agent makes: leave it out of "
            "--only, or leave --executor out"
        )
    return tuple(a for a in attacks if isinstance(a, CandidateAttack))


def _levels(words: list[str] | None) -> tuple[Isolation, ...]:
    from asia.judge.sandbox.availability import fitting_levels, why_not

    known = {str(level.isolation): level.isolation for level in fitting_levels()}
    if words is None:
        walled = [level.isolation for level in fitting_levels() if level.confined]
        found = tuple(level for level in walled if why_not(level) is None)
        if not found:
            raise UserError(
                f"no level of {', '.join(walled)} works here, and attacks run nowhere else: "
                "`asia doctor` says how to get one"
            )
        return found
    for word in words:
        if word not in known:
            raise UserError(f"--level {word}: expected one of {', '.join(known)}")
        reason = why_not(known[word])
        if reason is not None:
            raise UserError(f"level {word} does not work here: {reason}")
    return tuple(known[word] for word in dict.fromkeys(words))


def _layers(words: list[str]) -> tuple[Layer, ...]:
    from asia.judge.sandbox.types import Layer

    known = {str(x): x for x in (Layer.LANDLOCK, Layer.SECCOMP, Layer.RLIMITS)}
    for word in words:
        if word == Layer.NAMESPACES.value:
            raise UserError(
                "--without namespaces: level namespace without namespaces is level landlock; ask "
                "for --level landlock"
            )
        if word not in known:
            raise UserError(
                f"--without {word}: expected {EACH}, {CHECKS}, some of {', '.join(known)}, or some "
                f"of {', '.join(_check_names())}"
            )
    return tuple(known[word] for word in dict.fromkeys(words))
