"""Options of a jail: access of a program in it to more than its workspace."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from asia.drive.command import Access

_option = partial(typer.Option, rich_help_panel="Jail of a coding agent")


@dataclass(frozen=True)
class JailOptions:
    """Access of a program in a jail."""

    network: Annotated[
        bool, _option("--network", help="Allow network access, which hosted models need.")
    ] = False
    agent_config: Annotated[
        list[Path] | None,
        _option(
            help="Configuration folder or file of the agent, such as ~/.claude; it gets a copy."
        ),
    ] = None
    agent_mount: Annotated[
        list[Path] | None,
        _option(help="Folder that the agent may read, such as its installation."),
    ] = None
    pass_env: Annotated[
        list[str] | None,
        _option(help="Environment variable to pass to the agent, such as its key."),
    ] = None

    def access(self, keys: tuple[str, ...] = ()) -> Access:
        """Return the access. keys: variables to pass on if they are set. Raises UserError for a
        missing path or variable."""
        from asia.drive.command import Access

        configs, mounts = self.agent_config or (), self.agent_mount or ()
        _check_given((*configs, *mounts), self.pass_env or ())
        return Access(
            network=self.network,
            mounts=tuple(p.expanduser().resolve() for p in mounts),
            # Not resolved: a link keeps its own name below the agent's home.
            configs=tuple(Path(os.path.abspath(p.expanduser())) for p in configs),
            variables=(*keys, *(self.pass_env or ())),
        )


def access_settings(access: Access) -> dict[str, str]:
    """Return the settings for the ledger."""
    return {
        "network": "yes" if access.network else "no",
        "mounts": _names(access.mounts),
        "configs": _names(access.configs),
    }


def jail_words(access: Access) -> str:
    """Return a phrase on what a program in the jail can reach."""
    network = "the network" if access.network else "no network (hosted models need --network)"
    shown = ", ".join(str(p) for p in (*access.mounts, *access.configs)) or "nothing else of yours"
    return f"in a jail (level namespace) with its workspace, {network}, {shown}"


def _names(paths: Sequence[Path]) -> str:
    home = str(Path.home())
    return ", ".join(re.sub(f"^{re.escape(home)}(?=/|$)", "~", str(p)) for p in paths) or "none"


def _check_given(paths: Sequence[Path], variables: Sequence[str]) -> None:
    from asia.errors import UserError

    for path in paths:
        if not path.expanduser().exists():
            raise UserError(f"{path} does not exist: give a folder or file that does")
    for variable in variables:
        if variable not in os.environ:
            raise UserError(f"--pass-env {variable}: the variable is not set; export it first")
