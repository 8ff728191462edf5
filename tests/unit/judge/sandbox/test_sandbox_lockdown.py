"""The filter read as the kernel reads it, for both architectures, and the order of locking in."""

import errno
import os
import re
import struct
import subprocess
import sys
from pathlib import Path

import pytest

from asia.judge.sandbox.availability import why_not
from asia.judge.sandbox.layers import landlock, seccomp
from asia.judge.sandbox.layers.environment import package_folder
from asia.judge.sandbox.types import Isolation

ALLOW, KILL, TRAP = 0x7FFF0000, 0x80000000, 0x00030000
EPERM, ENOSYS = 0x00050000 | errno.EPERM, 0x00050000 | errno.ENOSYS
ARCHITECTURES = {"x86_64": 0xC000003E, "aarch64": 0xC00000B7}
PID = 4321
LOCKED = pytest.mark.skipif(why_not(Isolation.LANDLOCK) is not None, reason="no Landlock here")


def decide(machine: str, number: int, *arguments: int, architecture: int | None = None) -> int:
    """Run the filter over one system call and return the kernel's decision."""
    code = struct.iter_unpack("@HBBI", seccomp.build(machine, PID))
    program = list(code)
    words = (*arguments, 0, 0, 0, 0, 0, 0)[:6]
    data = struct.pack(
        "<iIQ6Q", number, architecture or ARCHITECTURES[machine], 0, *(w % 2**64 for w in words)
    )
    place, value = 0, 0
    while True:
        operation, if_true, if_false, k = program[place]
        place += 1
        match operation:
            case 0x20:
                (value,) = struct.unpack_from("<I", data, k)
            case 0x54:
                value &= k
            case 0x15 | 0x25 | 0x45:
                holds = {0x15: value == k, 0x25: value > k, 0x45: bool(value & k)}[operation]
                place += if_true if holds else if_false
            case 0x06:
                return k
            case _:
                raise AssertionError(operation)


@pytest.fixture(params=ARCHITECTURES)
def machine(request) -> str:
    return request.param


def test_every_listed_call_is_denied_and_others_pass(machine):
    known = seccomp.numbers(machine)
    checked = {"clone", "clone3", "kill", "tgkill", "prlimit64", "fcntl", "ioctl", "prctl"}
    checked |= {"futex", "exit", "exit_group", "madvise", "mmap", "clock_gettime", "clock_getres"}
    checked |= {"clock_nanosleep"}
    for name, number in known.items():
        if name not in checked | {"seccomp"}:
            assert decide(machine, number) == EPERM, name
    for number in set(range(451)) - set(known.values()):
        assert decide(machine, number) == ALLOW, number
    assert len(set(known.values())) == len(known)


def test_calls_with_arguments_are_decided_by_them(machine):
    known = seccomp.numbers(machine)
    thread = 0x003D0F00
    assert decide(machine, known["clone"], thread) == ALLOW
    assert decide(machine, known["clone"], 17) == EPERM
    assert decide(machine, known["clone"], thread | 0x10000000) == EPERM
    assert decide(machine, known["clone3"], 0) == ENOSYS
    for name in ("kill", "tgkill"):
        before = () if name == "kill" else (PID,)
        for sent in range(65):
            verdict = decide(machine, known[name], PID, *before, sent)
            assert verdict == (EPERM if sent == 9 else ALLOW), (name, sent)
        for other in (0, 1, -1, -PID, PID + 1):
            assert decide(machine, known[name], other) == EPERM
    for name in ("exit", "exit_group"):
        for code in range(600):
            verdict = KILL if code % 256 == 137 else ALLOW
            assert decide(machine, known[name], code) == verdict, code
    limits = known["prlimit64"]
    assert decide(machine, limits, 0, 7, 0) == ALLOW
    assert decide(machine, limits, PID, 7, 0) == ALLOW
    assert decide(machine, limits, 1, 7, 0) == EPERM
    assert decide(machine, limits, 0, 7, 1) == EPERM
    assert decide(machine, limits, 0, 7, 1 << 32) == EPERM
    assert decide(machine, known["prctl"], 1) == EPERM
    assert decide(machine, known["prctl"], 15) == ALLOW
    for advice in range(30):
        verdict = EPERM if advice in (12, 20, 21) else ALLOW
        assert decide(machine, known["madvise"], 0, 4096, advice) == verdict


def test_mappings_are_private_and_clocks_are_those_of_this_process(machine):
    known = seccomp.numbers(machine)
    private, anonymous, huge, shared_to_be_checked, droppable = 2, 0x20, 0x40000, 3, 8
    for more in (0, anonymous, 0x20000 | anonymous, 0x10, 1 << 32):
        assert decide(machine, known["mmap"], 0, 4096, 3, private | more) == ALLOW
        for kind in (0, 1, shared_to_be_checked, droppable, private | huge):
            assert decide(machine, known["mmap"], 0, 4096, 3, kind | more) == EPERM
    for name in ("clock_gettime", "clock_getres", "clock_nanosleep"):
        for clock in range(12):
            assert decide(machine, known[name], clock) == ALLOW
        for pid in (0, 1, PID, 4194304):
            for kind in (0, 1, 2, 3):
                assert decide(machine, known[name], ~pid << 3 | kind) == EPERM
                assert decide(machine, known[name], (~pid << 3 | kind) % 2**32) == EPERM


def test_files_cannot_be_marked_and_shared_memory_cannot_be_waited_on(machine):
    known = seccomp.numbers(machine)
    for command in range(2000):
        allowed = command in (0, 1, 2, 3, 4, 1030, 1032)
        assert decide(machine, known["fcntl"], 0, command) == (ALLOW if allowed else EPERM)
    for request in (0x5412, 0x541C, 0x5452, 0x40086602, 0x40046602, 0x401C5820, 0xC0045877):
        assert decide(machine, known["ioctl"], 0, request) == EPERM
    for request in (0x5401, 0x541B, 0x5421, 0x5451, 0x802C542A):
        assert decide(machine, known["ioctl"], 0, request) == ALLOW
    again = 0x00050000 | errno.EAGAIN
    shared = {0: TRAP, 1: ALLOW, 9: again, 9 | 0x100: again}
    for operation in range(0x200):
        verdict = ALLOW if operation & 0x80 else shared.get(operation, EPERM)
        assert decide(machine, known["futex"], 0, operation) == verdict


def test_foreign_and_unknown_calls(machine):
    other = ARCHITECTURES["aarch64" if machine == "x86_64" else "x86_64"]
    assert decide(machine, 1, architecture=other) == KILL
    assert decide(machine, 451) == ENOSYS
    assert decide(machine, 0x40000001) == (KILL if machine == "x86_64" else ENOSYS)


@pytest.mark.parametrize(
    ("machine", "header"),
    [
        ("x86_64", "/usr/include/x86_64-linux-gnu/asm/unistd_64.h"),
        ("aarch64", "/usr/include/asm-generic/unistd.h"),
    ],
)
def test_numbers_are_those_of_the_kernel(machine, header):
    if not Path(header).is_file():
        pytest.skip("the kernel's headers are not installed")
    text = Path(header).read_text()
    there = {
        name: int(number)
        for name, number in re.findall(r"#define __NR(?:3264)?_(\w+)\s+(\d+)", text)
    }
    for name, number in seccomp.numbers(machine).items():
        assert there[name] == number, name


@pytest.mark.parametrize(
    ("code", "words"),
    [(errno.ENOSYS, "5.13"), (errno.EOPNOTSUPP, "boot"), (errno.EPERM, "refused")],
)
def test_a_kernel_without_landlock_is_named(monkeypatch, code, words):
    def fail(*arguments):
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(landlock, "_call", fail)
    assert words in (landlock.why_not() or "")


def run(script: str) -> subprocess.CompletedProcess[str]:
    """A fresh Python that has the modules of the worker at hand."""
    folder = package_folder() / "judge" / "sandbox" / "layers"
    lines = f"import sys, threading, os\nsys.path.insert(0, {str(folder)!r})\n{script}"
    command = [sys.executable, "-I", "-S", "-B", "-c", lines]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)


WAITING_THREAD = """
go, answers = threading.Event(), []
def work():
    go.wait()
    try:
        answers.append(ATTEMPT)
    except OSError as error:
        answers.append(type(error).__name__)
thread = threading.Thread(target=work)
thread.start()
LOCK
go.set()
thread.join()
print(answers)
"""


@LOCKED
def test_landlock_leaves_running_threads_free_so_that_locking_in_refuses_them():
    free = WAITING_THREAD.replace("ATTEMPT", "len(os.listdir('/')) > 0")
    alone = run(free.replace("LOCK", "import landlock; landlock.restrict([], [])"))
    assert alone.stdout == "[True]\n", alone.stderr
    lock = (
        "import lockdown\n"
        "try:\n    lockdown.confine(['landlock'], [])\n"
        "except RuntimeError as error:\n    print(error)"
    )
    assert "several threads run already" in run(free.replace("LOCK", lock)).stdout


@LOCKED
def test_the_filter_binds_threads_that_run_already():
    attempt = WAITING_THREAD.replace("ATTEMPT", "os.chmod('/nowhere', 0)")
    assert run(attempt.replace("LOCK", "import seccomp")).stdout == "['FileNotFoundError']\n"
    bound = run(attempt.replace("LOCK", "import seccomp; seccomp.install()"))
    assert bound.stdout == "['PermissionError']\n", bound.stderr


@LOCKED
def test_a_trial_finds_an_ineffective_layer():
    script = "import lockdown; print(lockdown.holds(['LAYER'], '/usr'))"
    for layer in ("landlock", "seccomp"):
        assert "stops nothing" in run(script.replace("LAYER", layer)).stdout
    assert run(script.replace("LAYER", "rlimits")).stdout == "None\n"
