"""A command that lists the impulse responses that a search tried."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from asia.ledger.run import open_run


def taps(run: Annotated[Path, typer.Argument(help="Folder of a run.")]) -> None:
    """Print V of every finite impulse response of a run."""
    for experiment in open_run(run).view.finished:
        if experiment.proposed.family == "fir" and experiment.score is not None:
            typer.echo(f"{experiment.proposed.title}: V = {experiment.score.value:.4g}")
