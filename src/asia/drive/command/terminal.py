"""Program on its own pseudo-terminal, shown on the user's terminal: it cannot reach the terminal
that other programs use.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import pty
import select
import signal
import subprocess
import sys
import termios
import tty
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from pathlib import Path

_BYTES = 65536
_TICK_SECONDS = 0.2


def on_terminal() -> bool:
    """Return whether this process has the user's terminal."""
    return sys.stdin.isatty() and sys.stdout.isatty()


def run_on_terminal(arguments: list[str], environment: Mapping[str, str], folder: Path) -> int:
    """Run it to its end; its exit code. Where standard input is no terminal it gets the streams of
    this process."""
    if not on_terminal():
        return subprocess.run(arguments, env=environment, cwd=folder, check=False).returncode
    ours, theirs = pty.openpty()
    try:
        _copy_size(ours)
        process = subprocess.Popen(
            arguments, stdin=theirs, stdout=theirs, stderr=theirs, env=environment, cwd=folder,
            start_new_session=True,
        )  # fmt: skip
        os.close(theirs)
        with _raw(), _resizing(ours):
            _relay(ours, process)
        return process.wait()
    finally:
        os.close(ours)


def _relay(ours: int, process: subprocess.Popen[bytes]) -> None:
    """Copy both ways until the program has ended and nothing of its output is left."""
    keyboard, screen = sys.stdin.fileno(), sys.stdout.fileno()
    watched = [ours, keyboard]
    while True:
        ready = select.select(watched, [], [], _TICK_SECONDS)[0]
        if keyboard in ready:
            typed = os.read(keyboard, _BYTES)
            if typed:
                _write(ours, typed)
            else:
                watched.remove(keyboard)
        if ours in ready:
            with contextlib.suppress(OSError):  # Linux answers EIO once the other end is closed
                shown = os.read(ours, _BYTES)
                if shown:
                    _write(screen, shown)
                    continue
            return
        if not ready and process.poll() is not None:
            return


def _write(fd: int, data: bytes) -> None:
    while data:
        data = data[os.write(fd, data) :]


@contextmanager
def _raw() -> Generator[None]:
    """Keys reach the program one by one, Ctrl-C as well."""
    keyboard = sys.stdin.fileno()
    before = termios.tcgetattr(keyboard)
    try:
        tty.setraw(keyboard)
        yield
    finally:
        termios.tcsetattr(keyboard, termios.TCSADRAIN, before)


@contextmanager
def _resizing(ours: int) -> Generator[None]:
    """Keep the size of the program's terminal equal to that of the user's."""
    before = signal.signal(signal.SIGWINCH, lambda number, frame: _copy_size(ours))
    try:
        yield
    finally:
        signal.signal(signal.SIGWINCH, before)


def _copy_size(ours: int) -> None:
    with contextlib.suppress(OSError):
        size = fcntl.ioctl(sys.stdin.fileno(), termios.TIOCGWINSZ, bytes(8))
        fcntl.ioctl(ours, termios.TIOCSWINSZ, size)
