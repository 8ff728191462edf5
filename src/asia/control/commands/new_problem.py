"""asia init --control: the problem of a search for a controller, from a run."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Annotated, Any

import typer

from asia._text import say
from asia.data.preprocess import Preparation
from asia.errors import UserError
from asia.interfaces.cli.init import InitAnswers, split_at_commas
from asia.interfaces.cli.options import (
    DEFAULT_RUNS,
    CandidateLevel,
    Runs,
    candidate_level,
    run_directory,
)


def problem_options(
    command: Callable[[], None],
    given: Mapping[str, Any],
    *,
    control: Annotated[
        str | None,
        typer.Option(
            help="Run whose models become the plant of a search for a controller. --inputs are "
            "those of the controller, others disturbances; --outputs those with a set point."
        ),
    ] = None,
    isolation: CandidateLevel = None,
    runs: Runs = DEFAULT_RUNS,
) -> None:
    """asia init NAME --control RUN writes the problem of a search for a controller: the models of
    the run are the plant, and the ranges of its records the limits."""
    if control is None:
        command()
        return
    answers = given["answers"]
    # A run has its records, and their test and preprocessing, already.
    changed = replace(answers, inputs=[], outputs=[]) != InitAnswers()
    if changed or given["preparation"] != Preparation() or given["time"] or given["columns"]:
        raise UserError("--control takes the records of the run: give --inputs, --outputs only")
    from asia.control.control_problem import control_problem_of_run

    made = control_problem_of_run(
        given["name"], run_directory(runs, control), split_at_commas(answers.inputs),
        split_at_commas(answers.outputs), isolation=candidate_level(isolation),
    )  # fmt: skip
    for line in made.lines:
        say(line)
    say(f"wrote    {made.path}")
    say(f"next     asia run {given['name']}")
