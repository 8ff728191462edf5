"""asia init: a problem from CSV files."""

from __future__ import annotations

import sys
from math import inf
from pathlib import Path
from typing import Annotated

import typer

from asia.errors import UserError

SEAL_FRACTION = 0.2
LISTS = ("--train", "--test", "--inputs", "--outputs")


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("init")(init)


def init(
    name: Annotated[Path, typer.Argument(help="Directory to make; its name is the problem's.")],
    train: Annotated[list[Path], typer.Option(help="Training records, CSV with a header row.")],
    inputs: Annotated[list[str], typer.Option(help="Input columns.")],
    outputs: Annotated[list[str], typer.Option(help="Output columns.")],
    sampling_time: Annotated[float, typer.Option(help="Sampling time in seconds, above 0.")],
    test: Annotated[list[Path] | None, typer.Option(help="Test records, sealed.")] = None,
    seal: Annotated[
        bool | None,
        typer.Option(
            "--seal/--no-seal",
            help="Without --test: seal the last 20 % of each record as the test.",
        ),
    ] = None,
) -> None:
    """Write a minimal problem: asia init NAME --train a.csv --inputs u --outputs y ..."""
    from asia.problem.load import init_problem

    if not 0 < sampling_time < inf:
        raise UserError(
            f"--sampling-time is {sampling_time:g}: expected a number of seconds above 0"
        )
    if not test and seal is None and sys.stdin.isatty():
        seal = typer.confirm(
            "No --test given. Seal the last 20 % of each record as the test?", default=True
        )
    fraction = SEAL_FRACTION if seal and not test else None
    written = init_problem(
        name,
        train=train,
        test=test or [],
        inputs=inputs,
        outputs=outputs,
        sampling_time=sampling_time,
        seal_fraction=fraction,
    )
    print(f"wrote    {written}")
    if fraction is not None:
        print("sealed   the last 20 % of each record; the search will not see it")
    elif not test:
        print("note     no test data: asia unseal will have nothing to open")
    print(f"next     describe the system in {written.parent / 'description.md'}")
    print(f"         asia check {name}")
    print(f"         asia run {name}")
