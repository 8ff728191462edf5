"""Options of where evaluations run, and of how many experiments run at a time."""

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
            help="Experiments in flight: each is proposed before the results of the last N - 1.",
        ),
    ] = 1
    stop_folds: Annotated[
        bool,
        typer.Option(
            "--stop-folds",
            help="Pass over the folds of a candidate that is far behind the best without them.",
        ),
    ] = False
    device: Annotated[
        str,
        typer.Option(
            help="What networks are trained on: cpu, gpu (NVIDIA, extra gpu), or auto for a GPU "
            "where there is one."
        ),
    ] = "cpu"
    executor: Annotated[
        str,
        typer.Option(
            help="Where folds are fitted: local, local:N at once, dask://HOST:PORT, dask:FILE, "
            "dask-slurm:FILE."
        ),
    ] = "local"

    def chosen(self) -> Executor:
        """The executor. Raises UserError where there is none of that name."""
        from asia.executor import make_executor

        return make_executor(self.executor)
