"""Options of the evaluation: executor, device, experiments at a time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from asia.executor import Executor


@dataclass(frozen=True)
class EngineOptions:
    """Options of a command that evaluates many candidates."""

    parallel: Annotated[
        int,
        typer.Option(
            min=1,
            help="Experiments at a time: each is proposed before the last N - 1 have results.",
        ),
    ] = 1
    stop_folds: Annotated[
        bool,
        typer.Option(
            "--stop-folds",
            help="Skip the remaining folds of a candidate that is far behind the best.",
        ),
    ] = False
    device: Annotated[
        str,
        typer.Option(
            help="Device for networks: cpu, gpu (NVIDIA, extra gpu), or auto (a GPU if present)."
        ),
    ] = "cpu"
    executor: Annotated[
        str,
        typer.Option(
            help="Where folds are fitted: local, local:N (N jobs), dask://HOST:PORT, dask:FILE, "
            "dask-slurm:FILE."
        ),
    ] = "local"

    def chosen(self) -> Executor:
        """Make the executor. Raises UserError for an unknown name."""
        from asia.executor import make_executor

        return make_executor(self.executor)
