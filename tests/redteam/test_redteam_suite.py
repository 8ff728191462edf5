"""The suite: complete, each attack stopped as it says and a real one, and the page of the manual
as it is."""

import os
import signal
import socket
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from asia.agents.library.family import Family
from asia.errors import Reason, SandboxError
from asia.judge.sandbox.availability import why_not
from asia.judge.sandbox.types import Isolation, Layer
from tests.redteam.arena import Interruption, attack_candidate
from tests.redteam.attacks.source import candidate
from tests.redteam.attacks.table import ATTACKS
from tests.redteam.evidence import (
    Traces,
    a_step_succeeded,
    conclude,
    scores_better,
    targets,
)
from tests.redteam.honest import HonestProblem, small_problems, try_honest
from tests.redteam.outside.outer_sandbox import (
    inside,
    read_finding,
    why_no_outer,
    write_finding,
)
from tests.redteam.outside.without_isolation import CONTROL, OFF
from tests.redteam.suite import (
    RedTeamPlan,
    RedTeamReport,
    honest_plan,
    line,
    report_table,
    run_suite,
    summary,
)
from tests.redteam.types import (
    ANY_LEVEL,
    Attack,
    AttackVerdict,
    Barrier,
    CandidateAttack,
    Finding,
    HonestFinding,
    Observed,
)

CANDIDATES = [attack for attack in ATTACKS if isinstance(attack, CandidateAttack)]
WORKING = tuple(x for x in (Isolation.NAMESPACE, Isolation.LANDLOCK) if why_not(x) is None)
ONE_LEVEL = WORKING[0] if WORKING else None
NO_OUTER = why_no_outer()
needs_level = pytest.mark.skipif(ONE_LEVEL is None, reason="no level keeps intent in here")
needs_outer = pytest.mark.skipif(NO_OUTER is not None, reason=str(NO_OUTER))


def arx(problem: HonestProblem) -> Family:
    return next(row for row in problem.families if row.name == "arx")


@pytest.fixture(scope="module")
def honest() -> HonestFinding:
    """One honest candidate, tried."""
    if ONE_LEVEL is None:
        pytest.skip("no level keeps intent in here")
    tanks, _ = small_problems()
    return try_honest(tanks, arx(tanks), ONE_LEVEL, Interruption())


def one_of_each_kind() -> tuple[Attack, ...]:
    """Return for every barrier the first attack that it stops."""
    firsts = {min((a.number for a in ATTACKS if stop in a.stops), default=0) for stop in Barrier}
    return tuple(attack for attack in ATTACKS if attack.number in firsts)


@pytest.fixture(
    scope="module",
    params=[
        pytest.param("each kind", marks=pytest.mark.slow),
        pytest.param("all", marks=pytest.mark.long),
    ],
)
def report(request: pytest.FixtureRequest) -> RedTeamReport:
    """Attacks at the levels that work here, and with isolation off: all of both before a release,
    one attack of each kind at the strongest level otherwise."""
    if ONE_LEVEL is None:
        pytest.skip("no level keeps intent in here")
    whole = request.param == "all"
    levels, attacks = (WORKING, ATTACKS) if whole else ((ONE_LEVEL,), one_of_each_kind())
    return run_suite(RedTeamPlan(levels, attacks, prove=NO_OUTER is None))


def test_no_number_or_name_is_given_twice():
    numbers = [attack.number for attack in ATTACKS]
    assert numbers == sorted({*numbers})
    assert len({attack.name for attack in ATTACKS}) == len(ATTACKS)


def test_every_attack_is_stopped_at_every_level(report):
    assert [f for f in report.findings if f.through and f.level != OFF] == []
    played = {(f.number, f.level) for f in report.findings if f.level != OFF}
    expected = {
        (attack.number, level)
        for attack in report.plan.attacks
        for level in (
            map(str, report.plan.levels) if isinstance(attack, CandidateAttack) else [ANY_LEVEL]
        )
    }
    assert played == expected
    assert report.stopped == len(report.plan.attacks)


def test_every_attack_is_stopped_by_an_expected_barrier(report):
    expected = {attack.number: {*map(str, attack.stops)} for attack in report.plan.attacks}
    stopped = [f for f in report.findings if f.level != OFF]
    assert [f for f in stopped if not {*f.stops} <= expected[f.number]] == []


@needs_outer
def test_every_attack_succeeds_with_isolation_off(report):
    assert report.unproven == ()
    assert report.proven == len(report.plan.attacks)
    assert report.passed


@pytest.mark.long
@needs_outer
def test_no_attack_succeeds_by_failing():
    """The same candidates with a fit that only raises."""
    found = list(inside([CONTROL, "", *(str(attack.number) for attack in CANDIDATES)]))
    assert len(found) == len(CANDIDATES)
    assert [f for f in found if f.through] == []


def test_the_page_has_every_attack_of_the_suite():
    page = (Path(__file__).parents[2] / "docs" / "redteam.md").read_text()
    named = [f"{attack.number} {attack.name}" for attack in ATTACKS]
    assert [name for name in named if f" {name}," not in page and f" {name} |" not in page] == []


@needs_level
def test_a_candidate_that_really_is_better_counts_as_through():
    """A better model is what a successful cheat looks like from outside."""
    saturated = "honest(2 * np.tanh(past_u), past_y, 2 * np.tanh(u))"
    source = candidate(after=saturated, top="POLE, GAIN = 0.75, 0.25")
    attack = CandidateAttack(
        1, "better", "is better", {"": source}, scores_better, (Barrier.PARENT,)
    )
    finding = attack_candidate(attack, ONE_LEVEL)
    assert finding.verdict is AttackVerdict.THROUGH
    assert "honest" in finding.note


@needs_level
def test_traces_count_as_success(monkeypatch):
    monkeypatch.setattr(Traces, "survivors", lambda self: ("process 1",))
    finding = attack_candidate(CANDIDATES[0], ONE_LEVEL)
    assert finding.verdict is AttackVerdict.THROUGH
    assert "left behind" in finding.note


# Under a filter that allows everything; its parent ends, and it stays.
ORPHAN = """
import ctypes, os, time
if os.fork() == 0:
    libc = ctypes.CDLL(None)
    libc.prctl(38, 1, 0, 0, 0)
    rule = (ctypes.c_uint16 * 4)(0x06, 0, 0, 0x7FFF)
    head = (ctypes.c_uint64 * 2)(1, ctypes.addressof(rule))
    assert libc.prctl(22, 2, head, 0, 0) == 0
    print(os.getpid(), flush=True)
    time.sleep(60)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")
def test_an_unmarked_process_is_found_and_those_of_others_are_not(tmp_path, monkeypatch):
    from tests.redteam import evidence as module

    monkeypatch.setattr(module, "_PATIENCE_SECONDS", 0.0)
    traces = Traces("rt", 1, str(tmp_path))
    child = ORPHAN.replace("if os.fork() == 0:", "if True:")
    with subprocess.Popen([sys.executable, "-c", child], stdout=subprocess.PIPE) as ours:
        assert ours.stdout is not None
        ours.stdout.readline()
        assert f"process {ours.pid}" not in traces.survivors()
        ours.kill()
    with subprocess.Popen([sys.executable, "-c", ORPHAN], stdout=subprocess.PIPE) as starter:
        assert starter.stdout is not None
        pid = int(starter.stdout.readline())
        starter.wait()
        try:
            assert f"process {pid}" in traces.survivors()
        finally:
            os.kill(pid, signal.SIGKILL)


def test_a_port_is_free_for_tcp_and_udp(monkeypatch):
    with socket.socket(type=socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        taken = other.getsockname()[1]
        ports, serve = iter([taken, 0]), socket.create_server
        monkeypatch.setattr(socket, "create_server", lambda at: serve((at[0], next(ports))))
        with targets(64) as given:
            assert given.port != taken


def test_files_are_found_by_place_and_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    playground = tmp_path / "playground"
    playground.mkdir()
    (tmp_path / "model.bin").symlink_to("ledger")
    traces = Traces("rt0123456789", 1, str(playground))
    assert traces.strays() == ()
    of_the_attack = ("rt0123456789-file", "conftest.py", "playground/anything", "log.txt")
    for name in (*of_the_attack[:3], "sitecustomize.py", "somebody's"):
        (tmp_path / name).write_text("rt0123456789" if name == "conftest.py" else "")
    (tmp_path / "log.txt").symlink_to("ledger")
    assert {*traces.strays()} == {str(tmp_path / name) for name in of_the_attack}
    left = {path.name for path in tmp_path.iterdir()}
    assert left == {"playground", "model.bin", "log.txt", "sitecustomize.py", "somebody's"}


@pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")
def test_a_neighbour_is_seen_to_be_hurt():
    with targets(64) as given:
        assert given.neighbour.hurt == ""
        os.setpriority(os.PRIO_PROCESS, given.other, 19)
        assert "priority 19" in given.neighbour.hurt
        os.kill(given.other, signal.SIGSTOP)
        os.waitid(os.P_PID, given.other, os.WSTOPPED | os.WNOWAIT)  # busy cores: it stops later
        assert "stands still" in given.neighbour.hurt
        os.kill(given.other, signal.SIGKILL)
        given.neighbour.process.wait()
        assert "ended" in given.neighbour.hurt


@needs_level
def test_an_honest_candidate_is_not_flagged_and_one_that_remembers_is(honest, monkeypatch):
    from tests.redteam import honest as _honest

    assert (honest.flagged, honest.failure, honest.words) == (False, None, "")
    tanks, _ = small_problems()
    counts = "CALLS = []\nclass M:\n    def simulate(self, past_u, past_y, u):\n"
    counts += (
        "        CALLS.append(1)\n        return u + len(CALLS)\ndef fit(t, c):\n    return M()\n"
    )
    monkeypatch.setattr(_honest.HonestProblem, "source", lambda self, row: counts)
    found = try_honest(tanks, arx(tanks), ONE_LEVEL, Interruption())
    assert found.flagged
    assert "replay" in found.words


@needs_level
def test_an_honest_candidate_that_fails_was_not_checked(monkeypatch):
    """A failing fit on the small problems is reported for the problems with limits of their own."""
    from tests.redteam import honest as _honest

    tanks, _ = small_problems()
    late = replace(tanks, seconds=0.2)
    sleeps = "import time\ndef fit(t, c):\n    time.sleep(9)\n"
    monkeypatch.setattr(_honest.HonestProblem, "source", lambda self, row: sleeps)
    row = arx(tanks)
    found = try_honest(late, row, ONE_LEVEL, Interruption())
    assert (found.flagged, found.failure) == (False, Reason.FIT_TIMEOUT)
    assert "NOT CHECKED" in line(found, {})
    small = RedTeamReport(RedTeamPlan((ONE_LEVEL,), (), False, ((late, row),)), (), (found,))
    words = "0 false alarms over 1 family (1 honest candidate), 1 not checked: arx, fit_timeout"
    assert summary(small, 1.0) == f"{words} (1 s)"
    assert not small.passed
    whole = replace(small.plan, honest=((replace(late, tiny=False), row),))
    assert replace(small, plan=whole).passed


@needs_level
def test_a_fit_ends_with_all():
    tanks, _ = small_problems()
    ending = Interruption()
    ending.begin()
    with pytest.raises(SandboxError):
        try_honest(tanks, arx(tanks), ONE_LEVEL, ending)


def test_every_family_is_among_the_honest():
    from asia.agents.library.registry import all_families

    # A simulator of the user's own comes with its problem.
    names = {row.name for row in all_families() if "plant" not in row.needs}
    assert {row.name for _, row in honest_plan(quick=True)} == names
    assert {row.name for _, row in honest_plan()} == names
    assert len(honest_plan()) > len(names)


def test_findings_come_back_from_the_outer_sandbox_as_they_were():
    finding = Finding(3, "namespace", AttackVerdict.BLOCKED, ("landlock",), "EACCES", ("seccomp",))
    assert read_finding(write_finding(finding)) == finding


@needs_outer
def test_a_process_may_do_what_its_user_may():
    chosen = tuple(a for a in ATTACKS if a.number in (1, 5, 13))
    found = run_suite(RedTeamPlan((Isolation.PROCESS,), chosen, prove=False))
    assert {f.number for f in found.findings if f.through} == {5, 13}
    assert found.stopped == 1
    assert not found.passed
    assert "| read the test file | THROUGH" in report_table(found)


def test_steps_are_blamed_on_the_layer_in_force():
    attack = next(a for a in CANDIDATES if a.number == 13)
    seen = Observed(value=1.0, honest=1.0, steps={"fork": "EPERM", "spawn": "EACCES"})
    walls = conclude(attack, "", seen, [Layer.SECCOMP, Layer.LANDLOCK], a_step_succeeded)
    assert walls.stops == ("seccomp", "landlock")
    assert walls.verdict is AttackVerdict.BLOCKED
    assert conclude(attack, "", seen, [], a_step_succeeded).stops == ("kernel",)
