"""Red-team suite: attacks at each level and with isolation off, honest candidates, tables."""

import os
import tempfile
from collections.abc import Callable, Collection, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from functools import partial
from itertools import zip_longest
from pathlib import Path

from asia.agents.library.family import Family
from asia.agents.library.registry import all_families
from asia.judge.executors import Executor
from asia.judge.sandbox.levels import LEVELS
from asia.judge.sandbox.types import Isolation, Layer
from tests.redteam import gated
from tests.redteam.arena import Interruption, attack_candidate, attack_unchecked
from tests.redteam.attacks.searches import Scene
from tests.redteam.attacks.table import ATTACKS
from tests.redteam.honest import HonestProblem, small_problems, try_honest
from tests.redteam.outside.outer_sandbox import inside
from tests.redteam.outside.without_isolation import OFF
from tests.redteam.problem import Check
from tests.redteam.types import (
    ANY_LEVEL,
    Attack,
    AttackVerdict,
    Barrier,
    CandidateAttack,
    Finding,
    HonestFinding,
    SearchAttack,
    SuspicionFinding,
)

# Everything at once: attacks at each level, the same with isolation off, honest candidates.


Result = Finding | HonestFinding | SuspicionFinding
Job = Callable[[], Iterator[Result]]
OnResult = Callable[[Result], None]


@dataclass(frozen=True)
class RedTeamPlan:
    """Plan of a red-team run."""

    levels: tuple[Isolation, ...]
    """The levels of isolation, strongest first."""
    attacks: tuple[Attack, ...] = ATTACKS
    prove: bool = True
    """Whether to play them with isolation off too, in an outer sandbox."""
    honest: tuple[tuple[HonestProblem, Family], ...] = ()
    """The problems, each with a family whose candidate must not be flagged."""
    executor: Executor | None = None
    """Executor of the attacks' folds, on this machine; None for this process."""


@dataclass(frozen=True)
class RedTeamReport:
    """Report of a red-team run."""

    plan: RedTeamPlan
    findings: tuple[Finding, ...]
    """Findings of the attacks, by number and level."""
    honest: tuple[HonestFinding, ...]

    @property
    def stopped(self) -> int:
        """Attacks that were blocked or flagged at every level."""
        played = {f.number for f in self.findings if f.level != OFF}
        return len(played - {f.number for f in self.findings if f.through and f.level != OFF})

    @property
    def unproven(self) -> tuple[int, ...]:
        """Attacks that were to succeed with isolation off and did not."""
        proven = {f.number for f in self.findings if f.through and f.level == OFF}
        return tuple(
            a.number for a in self.plan.attacks if self.plan.prove and a.number not in proven
        )

    @property
    def proven(self) -> int:
        """Attacks that succeeded with isolation off."""
        return len(self.plan.attacks) - len(self.unproven) if self.plan.prove else 0

    @property
    def false_alarms(self) -> int:
        """Honest candidates taken for cheats."""
        return sum(one.flagged for one in self.honest)

    @property
    def unchecked(self) -> tuple[HonestFinding, ...]:
        """Honest candidates that failed before they came to the checks."""
        return tuple(one for one in self.honest if one.failure is not None)

    @property
    def passed(self) -> bool:
        """Whether no attack got through, each succeeds with isolation off, and every honest
        candidate was checked and not flagged. On whole problems a fit may exceed its time."""
        small = {problem.name for problem, _ in self.plan.honest if problem.tiny}
        missed = any(one.problem in small for one in self.unchecked)
        stopped = self.stopped == len(self.plan.attacks)
        return stopped and self.false_alarms == 0 and not self.unproven and not missed


def run_suite(plan: RedTeamPlan, on_result: OnResult = lambda result: None) -> RedTeamReport:
    """Run the plan, two jobs at a time; `on_result` is called with each finding as it is made.

    Attacks without protection run in an outer sandbox, and so do levels that confine nothing.
    Raises SandboxError where a worker or the outer sandbox cannot be started.
    """
    interruption = Interruption()
    honest: list[Job] = [
        partial(_single, try_honest, p, row, plan.levels[0], interruption) for p, row in plan.honest
    ]
    first: list[Job] = []
    if plan.prove:
        first.append(partial(_outside, OFF, (), plan.attacks))
    searches = [a for a in plan.attacks if isinstance(a, SearchAttack)]
    if searches:
        first.append(partial(_play_searches, searches, plan.levels[0]))
    candidates = [a for a in plan.attacks if isinstance(a, CandidateAttack)]
    for level in plan.levels:
        if LEVELS[level].confined:
            first += [
                partial(_single, attack_candidate, attack, level, executor=plan.executor)
                for attack in candidates
            ]
        else:
            first.append(partial(_outside, level, (), candidates))
    # Attacks and fits in turns, so that no slow job is left for the end.
    turns = [job for pair in zip_longest(first, honest) for job in pair if job is not None]
    results = _run(turns, on_result, interruption)
    order = [*map(str, plan.levels), ANY_LEVEL, OFF]
    findings = [one for one in results if isinstance(one, Finding)]
    findings.sort(key=lambda f: (f.number, order.index(f.level)))
    return RedTeamReport(
        plan, tuple(findings), tuple(o for o in results if isinstance(o, HonestFinding))
    )


def each_layer(levels: Sequence[Isolation]) -> tuple[tuple[Isolation, tuple[Layer, ...]], ...]:
    """Every layer of these levels left out in turn; namespaces cannot be: that is level
    `landlock`."""
    return tuple(
        (level, (layer,))
        for level in levels
        for layer in LEVELS[level].layers
        if layer is not Layer.NAMESPACES and LEVELS[level].confined
    )


def without_layers(
    settings: Sequence[tuple[Isolation, tuple[Layer, ...]]],
    attacks: Sequence[Attack],
    on_result: OnResult = lambda result: None,
) -> tuple[Finding, ...]:
    """Run attacks without these layers, in an outer sandbox.

    Attacks that no layer of the sandbox affects are left out. Raises SandboxError when the outer
    sandbox cannot be started.
    """
    walled = [attack for attack in attacks if attack.walled]
    jobs = [partial(_outside, level, layers, walled) for level, layers in settings]
    return tuple(one for one in _run(jobs, on_result, Interruption()) if isinstance(one, Finding))


def without_checks(
    levels: Sequence[Isolation],
    attacks: Sequence[Attack],
    kinds: Collection[Check] = (),
    on_result: OnResult = lambda result: None,
) -> tuple[SuspicionFinding, ...]:
    """The variants of attacks that relations or principles stop, with these left out, or each with
    those that stop it; and with all. Attacks that none of them has a part in are left out. Raises
    SandboxError."""
    jobs: list[Job] = [
        partial(attack_unchecked, attack, level, off)
        for level in levels
        for attack in attacks
        if isinstance(attack, CandidateAttack)
        for off in [tuple(one for one in attack.checks if one in kinds or not kinds)]
        if off
    ]
    found = _run(jobs, on_result, Interruption())
    order = [str(level) for level in levels]
    known = [one for one in found if isinstance(one, SuspicionFinding)]
    return tuple(sorted(known, key=lambda one: (order.index(one.level), one.number)))


def honest_plan(quick: bool = False) -> tuple[tuple[HonestProblem, Family], ...]:
    """Every family of the library on both small problems, where it can be used.

    Args:
        quick: on one of them, in turns
    """
    tanks, drone = small_problems()
    if not quick:
        return tuple((p, row) for p in (tanks, drone) for row in p.families)
    chosen: list[tuple[HonestProblem, Family]] = []
    for place, row in enumerate(all_families()):
        wanted = (tanks, drone) if place % 2 else (drone, tanks)
        chosen += [(p, row) for p in wanted if row in p.families][:1]
    return tuple(chosen)


def _single(work: Callable[..., Result], *given: object, **named: object) -> Iterator[Result]:
    yield work(*given, **named)


def _outside(level: str, layers: Sequence[Layer], attacks: Sequence[Attack]) -> Iterator[Result]:
    numbers = [str(attack.number) for attack in attacks]
    nested = level != OFF and Layer.NAMESPACES in LEVELS[Isolation(level)].layers
    return inside([level, ",".join(layers), *numbers], nested=nested)


def _play_searches(attacks: Sequence[SearchAttack], level: Isolation) -> Iterator[Result]:
    """Run the attacks on the search once: the sandbox layers do not affect them."""
    with tempfile.TemporaryDirectory(prefix="asia-redteam-") as folder:
        scene = Scene(Path(folder), level)
        for attack in attacks:
            result = attack.play(scene)
            verdict = AttackVerdict.FLAGGED if result.flagged else AttackVerdict.BLOCKED
            verdict = AttackVerdict.THROUGH if result.succeeded else verdict
            stops = () if result.succeeded else tuple(map(str, result.stops))
            yield Finding(attack.number, ANY_LEVEL, verdict, stops, result.note)


def _run(jobs: Sequence[Job], on_result: OnResult, interruption: Interruption) -> list[Result]:
    """Results of all jobs. The first failure or interrupt ends the run: no further job begins, a
    job of many attacks ends after the current one, and a fit ends at once."""
    results: list[Result] = []

    def collect(job: Job) -> None:
        for result in job():
            if interruption.begun:
                return
            results.append(result)
            on_result(result)

    pool = ThreadPoolExecutor(min(2, os.cpu_count() or 1))
    try:
        futures: list[Future[None]] = [pool.submit(collect, job) for job in jobs]
        for future in as_completed(futures):
            future.result()
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
        interruption.begin()
        pool.shutdown()
    return results


# Findings as tables and sentences.


def report_table(report: RedTeamReport) -> str:
    """Format the report in Markdown, one row per attack, one column per level.

    Attacks that run once, independent of the level, are in the first column.
    """
    levels = [*map(str, report.plan.levels), *([OFF] if report.plan.prove else [])]
    found = {(f.number, f.level): f for f in report.findings}
    rows = [["#", "attack", *levels]]
    for attack in report.plan.attacks:
        cells = [_cell_text(found.get((attack.number, level))) for level in levels]
        played = found.get((attack.number, ANY_LEVEL))
        if played is not None:
            cells[0] = f"{ANY_LEVEL}: {_cell_text(played)}"
        rows.append([str(attack.number), attack.name, *cells])
    return _aligned(rows)


def attack_table(attacks: Sequence[Attack]) -> str:
    """Format the attacks in Markdown with the barriers that may stop them."""
    rows = [["#", "attack", "what it tries", "stopped by"]]
    rows += [[str(a.number), a.name, a.tries, ", ".join(a.stops)] for a in attacks]
    return _aligned(rows)


def gate_table(levels: Sequence[Isolation], attacks: Sequence[Attack]) -> str:
    """Run searches with the candidates of the attacks that the guard records alone stop, with the
    gate and without it, and format V, status and error on the guard records in Markdown; "" where
    there are none."""
    candidates = {
        f"{attack.number} {name}": source
        for attack in attacks
        if isinstance(attack, CandidateAttack) and attack.stops == (Barrier.GUARD,)
        for name, source in attack.sources.items()
    }
    if not candidates:
        return ""
    tables: list[str] = []
    with tempfile.TemporaryDirectory(prefix="asia-redteam-") as folder:
        for level in levels:
            (place := Path(folder, str(level))).mkdir()
            found = gated.rows(*gated.play_both(candidates, place, level))
            tables.append(f"Level {level}\n\n" + _aligned([gated.HEAD, *found]))
    return "\n\n".join(tables)


def without_table(findings: Sequence[Finding]) -> str:
    """Format the findings without layers in Markdown, by level and layers left out."""
    rows = [["level", "without", "comes back"]]
    for key in sorted(dict.fromkeys((f.level, f.without) for f in findings), reverse=True):
        back = sorted(f.number for f in findings if (f.level, f.without) == key and f.through)
        rows.append([key[0], ", ".join(key[1]), ", ".join(map(str, back)) or "nothing"])
    return _aligned(rows)


def unchecked_table(findings: Sequence[SuspicionFinding]) -> str:
    """V of each variant with and without the relations that were left out, in Markdown."""
    rows = [["#", "variant", "level", "honest V", "without", "V", "with all checks"]]
    for one in findings:
        value = "no score" if one.value is None else f"{one.value:.3g}"
        value += "" if one.succeeded else " (DOES NOT SUCCEED)"
        without = ", ".join(one.without)
        note = one.checked.note.removeprefix(f"{one.variant}: ")
        ended = f"{_word(one.checked)}: {note}"
        head = [str(one.number), one.variant, one.level, f"{one.honest:.3g}"]
        rows.append([*head, without, value, ended])
    return _aligned(rows)


def summary(report: RedTeamReport, seconds: float) -> str:
    """The last line."""
    count = len(report.plan.attacks)
    parts = [f"{report.stopped} of {count} blocked or flagged"] if count else []
    if report.honest:
        alarms = _counted(report.false_alarms, "false alarm")
        families = _counted(len({one.family for one in report.honest}), "family", "families")
        candidates = _counted(len(report.honest), "honest candidate")
        parts.append(f"{alarms} over {families} ({candidates})")
        missed = [f"{one.family}, {one.failure}" for one in report.unchecked]
        parts += [f"{len(missed)} not checked: {'; '.join(missed)}"] if missed else []
    if report.plan.prove:
        which = f" (not {', '.join(map(str, report.unproven))})" if report.unproven else ""
        parts.append(f"{report.proven} of {count} succeed with isolation off{which}")
    return ", ".join(parts) + f" ({seconds:.0f} s)"


def line(result: Finding | HonestFinding | SuspicionFinding, names: dict[int, str]) -> str:
    """Progress."""
    if isinstance(result, SuspicionFinding):
        words = "succeeds" if result.succeeded else "DOES NOT SUCCEED"
        head = f"{result.number:>2} {names[result.number]}, {result.variant}, {result.level}"
        return f"{head} without {', '.join(result.without)}: {words}; {_word(result.checked)}"
    if isinstance(result, HonestFinding):
        words = "FLAGGED" if result.flagged else "not flagged"
        words = words if result.failure is None else "NOT CHECKED"
        more = f": {result.words}" if result.words else ""
        return f"honest {result.family} on {result.problem}: {words}{more}"
    without = f" without {', '.join(result.without)}" if result.without else ""
    head = f"{result.number:>2} {names[result.number]}, {result.level}{without}: "
    stops = f" by {', '.join(result.stops)}" if result.stops else ""
    note = f" ({result.note})" if result.note else ""
    return head + _word(result) + stops + note


def _counted(number: int, one: str, many: str = "") -> str:
    return f"{number} {one if number == 1 else many or one + 's'}"


def _word(finding: Finding) -> str:
    if finding.level == OFF:
        return "succeeds" if finding.through else "DOES NOT SUCCEED"
    return "THROUGH" if finding.through else finding.verdict.value


def _cell_text(finding: Finding | None) -> str:
    if finding is None:
        return ""
    stops = f": {', '.join(finding.stops)}" if finding.stops and finding.level != OFF else ""
    return _word(finding) + stops


def _aligned(rows: Sequence[Sequence[str]]) -> str:
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    lines = [
        "| " + " | ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)) + " |"
        for row in rows
    ]
    lines.insert(1, "|" + "|".join("-" * (w + 2) for w in widths) + "|")
    return "\n".join(lines)
