"""asia doctor: isolation levels, plugins and attacks on this machine."""

from __future__ import annotations

import json as jsonlib
import signal
import socket
import sys
import time
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import partial
from types import FrameType
from typing import TYPE_CHECKING, Annotated, Any

import typer

from asia._plugins import Part
from asia._text import say, say_lines
from asia.errors import UserError
from asia.interfaces.cli.options import Json, given

if TYPE_CHECKING:
    from asia.assurance.redteam.problem import Check
    from asia.assurance.redteam.types import Attack, Finding, HonestFinding, SuspicionFinding
    from asia.judge.sandbox.availability import LevelState, Machine
    from asia.judge.sandbox.types import Isolation

    PrintResult = Callable[[Finding | HonestFinding | SuspicionFinding], None]

LISTS = ("--level", "--only", "--without", "--honest-on")
_EACH, _CHECKS = "each", "checks"
_INDENT = 13
WINDOWS = (
    "ASIA does not run on Windows directly. Run `wsl --install` in PowerShell to get Linux in "
    "WSL2. Then install ASIA in that Linux."
)
MACOS = (
    "ASIA was not tested on macOS. Candidates run at level sandbox-exec or process, without a "
    "memory limit. Use a Linux virtual machine or container for level namespace or landlock."
)
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
            metavar="N ...", help="Attacks by number; default: all, and the honest candidates."
        ),
    ] = None
    without: Annotated[
        list[str] | None,
        _option(
            metavar="LAYER|CHECK ...",
            help="Show which attacks succeed without some layers (landlock, seccomp, rlimits, "
            "pids; "
            "'each': one layer after the other) or without some checks (look-ahead, strangers, "
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
        bool, _option(help="Also show that the attacks work with isolation off (needs bubblewrap).")
    ] = True


def doctor(
    *,
    executor: Annotated[
        str | None,
        typer.Option(
            help="Test the machines of an executor instead: dask://HOST:PORT or dask:FILE. With "
            "--attack: its workers, on this machine, fit the folds of the attacks."
        ),
    ] = None,
    attack: Annotated[
        bool,
        typer.Option(
            "--attack",
            help="Run scripted attacks against this installation: each must be blocked or "
            "flagged, and honest candidates must not be. Exit code 1 if not.",
        ),
    ] = False,
    attacks: AttackOptions,
    json: Json = False,
) -> None:
    """Test every isolation level on this machine, print how to enable a stronger one, and list the
    installed plugins."""
    from asia._plugins import parts
    from asia.judge.sandbox.availability import machine, survey
    from asia.judge.sandbox.layers.pids import most_pids

    if attack:
        _run_attacks(attacks, executor, json=json)
        return
    for name in given(attacks):
        option = "no-prove" if name == "prove" else name.replace("_", "-")
        raise UserError(f"--{option} belongs to --attack: add --attack or leave it out")
    if executor is not None:
        _print_executor(executor, json=json)
        return
    here, levels = machine(), survey()
    used = next(state.level for state in levels if state.works)
    found, clash = (), None
    try:
        found = tuple(parts())
    except UserError as error:
        clash = str(error)
    if not json:
        _print_machine(here)
        _print_levels(levels)
        _print_parts(found, clash)
        say()
        say("docs/isolation.md lists the attacks that each level stops.")
        return
    listed: list[dict[str, Any]] = []
    for part in found:
        fields = asdict(part)
        kind = fields.pop("group").removeprefix("asia.")
        listed.append({"kind": kind, **fields, "failure": part.why_not()})
    answer = {
        "level": used,
        "machine": asdict(here),
        "levels": [asdict(state) for state in levels],
        "most_pids": most_pids(),
        "parts": listed,
        "clash": clash,
    }
    say(jsonlib.dumps(answer))


def _print_executor(name: str, *, json: bool) -> None:
    """Print every worker of an executor. Exit code 2 if one cannot work for a search from here."""
    from asia.judge.evaluation.machines import survey_machines
    from asia.judge.executors import make_executor, remote_executor_of

    remote = remote_executor_of(make_executor(name))
    states = [] if remote is None else survey_machines(remote)
    if json:
        say(jsonlib.dumps({"executor": name, "workers": [asdict(state) for state in states]}))
    elif remote is None:
        say(f"executor {name} fits folds on this machine: run asia doctor without --executor")
    for state in () if json else states:
        level = f"{state.isolation} ({', '.join(state.layers)})" if state.isolation else "none"
        say(
            f"worker     {state.worker} on {state.machine}, {state.cores} cores, "
            f"isolation {level}, round trip {1000 * state.round_trip:.0f} ms, "
            f"clock {state.clock:+.2f} s"
        )
        if state.unlike:
            say(f"{'':<11}{state.unlike}")
    if any(state.unlike or not state.isolation for state in states):
        raise typer.Exit(2)


def _print_machine(here: Machine) -> None:
    if sys.platform == "darwin":
        say(f"macOS      {MACOS}")
    memory = f", {here.memory_mb} MB of memory" if here.memory_mb else ""
    where = ", in a container" if here.container else ""
    say(f"machine    {here.system}, {here.architecture}, {here.cores} cores{memory}{where}")
    say(f"python     {here.python}, as {'root' if here.user == 'root' else 'an ordinary user'}")
    say(f"landlock   {f'version {here.landlock}' if here.landlock else 'none'}")
    say(f"bubblewrap {here.bubblewrap or 'none'}")


def _print_levels(levels: Sequence[LevelState]) -> None:
    from asia.judge.sandbox.layers.pids import REMEDY, PidsMechanism, most_pids

    say()
    chosen = False
    for state in levels:
        used = state.works and not chosen
        chosen = chosen or state.works
        words = f"works: {', '.join(state.layers)}" if state.works else "does not work"
        say(f"{state.level:<{_INDENT}}{words}{'   <- what a search uses here' if used else ''}")
        if state.pids is not None:
            held = f"at most {most_pids()} threads and processes a worker, held by {state.pids}"
            say(f"{'':<{_INDENT}}{held}")
            if state.pids is PidsMechanism.WATCHER:
                say(f"{'':<{_INDENT}}{REMEDY}")
        for lack in state.lacks:
            say(f"{'':<{_INDENT}}why not: {lack.reason}")
            say(f"{'':<{_INDENT}}to get it: {lack.remedy}")


def _print_parts(found: Sequence[Part], clash: str | None) -> None:
    say()
    if not found:
        say(f"{'plugged in':<{_INDENT}}{clash or 'nothing: no other package adds a part'}")
        return
    heads = [f"{p.group.removeprefix('asia.')} {p.name}" for p in found]
    width = max(_INDENT, *(len(head) + 2 for head in heads))
    for head, part in zip(heads, found, strict=True):
        say(f"{head:<{width}}{part.target}, of {part.package} {part.version}")
        if failure := part.why_not():
            say(f"{'':<{width}}does not load: {failure}")


# asia doctor --attack: run attacks against this installation.


def _run_attacks(options: AttackOptions, executor: str | None, *, json: bool) -> None:
    """Run scripted attacks against this installation: each must be blocked or flagged, and honest
    candidates must not be.

    Attacks run without isolation only in an outer sandbox. Exit code 1 if an attack succeeds, if an
    attack does not succeed even with isolation off, or if an honest candidate could not be checked.
    executor: workers of this machine that fit the folds of the attacks.
    """
    from asia.assurance.redteam.attacks.table import ATTACKS
    from asia.assurance.redteam.honest import problem_named
    from asia.assurance.redteam.outside.outer_sandbox import why_no_outer
    from asia.assurance.redteam.suite import (
        RedTeamPlan,
        honest_plan,
        line,
        report_table,
        run_suite,
        summary,
    )
    from asia.assurance.redteam.types import CandidateAttack
    from asia.judge.evaluation.machines import survey_machines
    from asia.judge.executors import make_executor, remote_executor_of

    only, honest_on, quick = options.only, options.honest_on, options.quick
    numbers = [attack.number for attack in ATTACKS]
    for number in only or ():
        if number not in numbers:
            raise UserError(f"--only {number}: there are attacks 1 to {max(numbers)}")
    attacks = tuple(a for a in ATTACKS if only is None or a.number in only)
    names = {attack.number: attack.name for attack in attacks}

    def print_result(result: Finding | HonestFinding | SuspicionFinding) -> None:
        say(line(result, names), file=sys.stderr, flush=True)
        if json:
            say(jsonlib.dumps(asdict(result)), flush=True)

    def refuse(option: str, why: str, **others: object) -> None:
        for name, value in others.items():
            if value:
                other = f"--{name.replace('_', '-')}"
                raise UserError(f"{option} and {other} do not go together: {option} {why}")

    if options.without:
        refuse(
            "--without",
            "plays attacks alone, in an outer sandbox",
            quick=quick,
            honest_on=honest_on,
            no_prove=not options.prove,
            executor=executor,
        )
        words = options.without
        checks = [word in _check_names() or word == _CHECKS for word in words]
        if any(checks) and (not all(checks) or (_CHECKS in words and len(words) > 1)):
            raise UserError(
                f"--without {' '.join(words)}: name layers, or checks, or one of {_EACH} and "
                f"{_CHECKS}"
            )
        run = _run_without_checks if all(checks) else _run_without_layers
        table = run(_levels(options.level), words, attacks, only is not None, print_result)
        if not json:
            say_lines(table)
        return
    if honest_on:
        why = "tries every family on its problems, and no attack"
        refuse("--honest-on", why, only=only, quick=quick, executor=executor)
    elif only:
        refuse("--only", "leaves the honest candidates out", quick=quick)
    elif executor:
        refuse("--executor", "leaves the honest candidates out", quick=quick)
    levels = _levels(options.level)
    missing = why_no_outer()
    if options.prove and missing is not None:
        say(f"attacks with isolation off are left out: {missing}", file=sys.stderr)
    honest = honest_plan(quick) if only is None and executor is None else ()
    engine = None
    if executor is not None:
        # Attacks aim at files and processes of this machine, and are made by candidates.
        engine = make_executor(executor)
        remote = remote_executor_of(engine)
        for state in survey_machines(remote) if remote else ():
            if state.machine != socket.gethostname():
                raise UserError(
                    f"--executor {executor}: worker {state.worker} is on {state.machine}, and "
                    "attacks aim at this machine; run asia doctor --attack there, without "
                    "--executor"
                )
        left = ", ".join(str(a.number) for a in attacks if not isinstance(a, CandidateAttack))
        if only is not None and left:
            raise UserError(
                f"--executor has no part in attack {left}, which an agent makes: leave it out of "
                "--only, or leave --executor out"
            )
        attacks = tuple(a for a in attacks if isinstance(a, CandidateAttack))
    if honest_on:
        problems = [problem_named(name) for name in honest_on]
        honest, attacks = tuple((p, row) for p in problems for row in p.families), ()
    proven = options.prove and missing is None and bool(attacks)
    plan = RedTeamPlan(levels, attacks, proven, honest, engine)
    begin = time.monotonic()
    with _one_interrupt():
        report = run_suite(plan, print_result)
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


def _run_without_layers(
    levels: Sequence[Isolation],
    words: list[str],
    attacks: Sequence[Attack],
    named: bool,
    print_result: PrintResult,
) -> str:
    """Run the attacks without some layers. named: whether the user named the attacks."""
    from asia.assurance.redteam.suite import each_layer, without_layers, without_table
    from asia.judge.sandbox.levels import LEVELS
    from asia.judge.sandbox.types import Layer

    if words == [_EACH]:
        settings = each_layer(levels)
    else:
        known = {str(x): x for x in (Layer.LANDLOCK, Layer.SECCOMP, Layer.RLIMITS, Layer.PIDS)}
        for word in words:
            if word == Layer.NAMESPACES.value:
                raise UserError(
                    "--without namespaces: level namespace without namespaces is level landlock; "
                    "ask for --level landlock"
                )
            if word not in known:
                raise UserError(
                    f"--without {word}: expected {_EACH}, {_CHECKS}, some of {', '.join(known)}, "
                    f"or some of {', '.join(_check_names())}"
                )
        layers = tuple(known[word] for word in dict.fromkeys(words))
        settings = tuple((at, layers) for at in levels if {*layers} <= {*LEVELS[at].layers})
    if not settings:
        raise UserError(f"--without {' '.join(words)}: no level asked for has these layers")
    unaffected = ", ".join(str(attack.number) for attack in attacks if not attack.walled)
    if named and unaffected:
        raise UserError(
            f"no layer has a part in attack {unaffected}: leave it out of --only, or leave "
            "--without out"
        )
    with _one_interrupt():
        return without_table(without_layers(settings, attacks, print_result), attacks)


def _run_without_checks(
    levels: Sequence[Isolation],
    words: list[str],
    attacks: Sequence[Attack],
    named: bool,
    print_result: PrintResult,
) -> str:
    """Run the attacks without some checks. named: whether the user named the attacks."""
    from asia.assurance.redteam.suite import unchecked_table, without_checks
    from asia.assurance.redteam.types import CandidateAttack
    from asia.judge.sandbox.levels import LEVELS

    for level in levels:
        if not LEVELS[level].confined:
            raise UserError(
                f"--without {' '.join(words)}: attacks do not run at level {level}, which confines "
                "nothing; leave --level out"
            )
    kinds = [] if words == [_CHECKS] else [_check_names()[word] for word in words]
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
    with _one_interrupt():
        return unchecked_table(without_checks(levels, concerned, kinds, print_result))


def _check_names() -> dict[str, Check]:
    from asia.assurance.redteam.problem import Principle
    from asia.judge.evaluation.relations import SuspicionKind

    return {str(kind).replace(" ", "-"): kind for kind in (*SuspicionKind, *Principle)}


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
