"""Candidates that imitate a worker killed from outside, as by a machine without memory: the fold
would run again, and the candidate would not be blamed."""

from __future__ import annotations

from asia.assurance.redteam.attacks.source import candidate

_TGKILL = "TGKILL = 234 if os.uname().machine == 'x86_64' else 131"

EXITS = {
    **{f"exit {code}": candidate(fit=f"os._exit({code})") for code in (137, 0, 1, 139, 143, 255)},
    "exit 137 by a thread": candidate(
        fit="import threading\nthreading.Thread(target=os._exit, args=(137,)).start()\n"
        "time.sleep(9)"
    ),
    "exit 137 with more bits": candidate(
        fit="libc.syscall(231 if os.uname().machine == 'x86_64' else 94, 0x189)"
    ),
    "exit 137 in simulate": candidate(before="os._exit(137)"),
    "kill": candidate(fit="os.kill(os.getpid(), signal.SIGKILL)"),
    "kill a thread": candidate(
        fit="call(libc.syscall(TGKILL, os.getpid(), os.getpid(), 9))", top=_TGKILL
    ),
    "kill the group": candidate(fit="os.kill(0, signal.SIGKILL)"),
}
