"""Access of a jailed program besides its workspace, with a check that it does not include the
runs.
"""

from __future__ import annotations

import contextlib
import shutil
from dataclasses import dataclass
from pathlib import Path

from asia.drive._program import Confinement
from asia.errors import UserError
from asia.problem.load import Problem
from asia.sandbox import Jail
from asia.search._secrecy import check_hidden_from_agent


@dataclass(frozen=True)
class Access:
    """Access of a jailed program."""

    network: bool = False
    """True if it reaches the network."""
    mounts: tuple[Path, ...] = ()
    """Folders that it sees, read-only."""
    configs: tuple[Path, ...] = ()
    """Its own files and folders, of which it gets a copy."""
    variables: tuple[str, ...] = ()
    """Names of environment variables passed on."""

    @property
    def confinement(self) -> Confinement:
        """Confinement of a jail with this access."""
        return Confinement.JAIL_WITH_NETWORK if self.network else Confinement.JAIL


def check_access(access: Access, directory: Path, problem: Problem) -> None:
    """Raises UserError when a folder would show the program the runs, the test data or their
    key."""
    runs = directory.resolve().parent
    for path in (*access.mounts, *access.configs):
        real = path.resolve()
        if real == runs or real in runs.parents or runs in real.parents:
            raise UserError(
                f"{path} would show the agent the runs in {runs}, whose ledgers it must "
                "not see: give a smaller folder, or another folder for the runs with "
                "--runs"
            )
    check_hidden_from_agent((*access.mounts, *access.configs), problem)


def check_program(program: str, access: Access | None) -> None:
    """Raises UserError when the program cannot be run in a jail with this access; None: outside."""
    if access is None:
        found = shutil.which(program)
    else:
        found = Jail(Path(), Path(), access.mounts).find(program)
    if found is None:
        raise UserError(
            f"the agent's program '{program}' cannot be run: install it. If it is installed "
            "in your home, give --agent-mount for its folder and for the folder that its "
            "link leads to"
        )


def copied_configs(access: Access, home: Path) -> tuple[Path, ...]:
    """The program's own files as a copy in `home`, which is made: what it changes there is lost
    with it."""
    home.mkdir()
    for path in access.configs:
        if path.is_dir():
            # Sockets and unreadable files are skipped.
            with contextlib.suppress(shutil.Error):
                shutil.copytree(path, home / path.name, symlinks=True, dirs_exist_ok=True)
        else:
            shutil.copy(path, home / path.name)
    return tuple(home / path.name for path in access.configs)
