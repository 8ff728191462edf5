"""Any program in the jail of a workspace: `asia agent workspace --jail CMD`."""

from __future__ import annotations

import contextlib
import os
import tempfile
from pathlib import Path

from asia.drive._answers import SearchProgress
from asia.drive._desk import RunDesk
from asia.drive._detached import start_search
from asia.drive._socket import DeskServer
from asia.drive._workspace import DESK_VARIABLE, Workspace, write_views
from asia.drive.command.access import Access, check_access, check_program, copied_configs
from asia.drive.command.terminal import on_terminal, run_on_terminal
from asia.errors import UserError
from asia.ledger import open_run
from asia.problem.load import Problem
from asia.sandbox import SOCKET_FOLDER, Jail, jail_environment

SOCKET = "desk.sock"
# Variables that terminal programs need.
_TERMINAL_VARIABLES = ("TERM", "COLORTERM")


def check_jail(words: list[str], access: Access, directory: Path, problem: Problem) -> None:
    """Raises UserError when there can be no jail here, the program cannot be run in it, or what is
    opened to it would show the runs or the test."""
    missing = Jail.why_not()
    if missing is not None:
        raise UserError(f"--jail: there can be no jail here ({missing}); see asia doctor")
    if not words:
        raise UserError("--jail: expected the command line of a program, such as bash or claude")
    check_access(access, directory, problem)
    check_program(words[0], access)


def run_jailed(place: Workspace, words: list[str], access: Access) -> int:
    """Run the program in the workspace's jail, to its end; its exit code. It submits through a
    socket; the search goes on in its own process afterwards. Raises UserError where the program
    cannot be started."""
    assert place.run is not None
    with tempfile.TemporaryDirectory(prefix="asia-agent-") as private:
        socket, home = Path(private) / "desk", Path(private) / "home"
        socket.mkdir()
        configs = copied_configs(access, home)
        jail = Jail(place.folder, socket, access.mounts, configs, access.network)
        passed = (*access.variables, *_TERMINAL_VARIABLES)
        environment = {
            **jail_environment(access.mounts),
            DESK_VARIABLE: f"{SOCKET_FOLDER}/{SOCKET}",
            **{name: os.environ[name] for name in passed if name in os.environ},
        }
        with DeskServer(socket / SOCKET, _RenewingDesk(place)):
            try:
                command = jail.command(words, terminal=on_terminal())
                return run_on_terminal(command, environment, place.folder)
            except OSError as error:
                raise UserError(f"the jail could not be started: {error.strerror}") from None


class _RenewingDesk(RunDesk):
    """Submission server that writes the views of the workspace before it reports the state of the
    search, because a jailed program cannot read the ledger.
    """

    def __init__(self, place: Workspace) -> None:
        assert place.run is not None
        super().__init__(place.run, start_search)
        self._place, self._run_directory = place, place.run
        self._written = -1

    def progress(self) -> SearchProgress:
        """See `Desk.progress`."""
        now = super().progress()
        if now.experiments != self._written:
            opened = open_run(self._run_directory)
            # An agent that makes its folder unwritable harms only itself.
            with contextlib.suppress(UserError):
                write_views(self._place.folder, opened.view, opened.store)
            self._written = now.experiments
        return now
