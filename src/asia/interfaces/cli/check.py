"""asia check: the data and the protocol of a problem."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from asia._text import say
from asia.interfaces.cli.options import DEFAULT_RUNS, ProblemName, Runs
from asia.problem.folds import make_folds


def check(
    problem: ProblemName,
    runs: Runs = DEFAULT_RUNS,
    draw: Annotated[bool, typer.Option(help="Draw the training data.")] = True,
) -> None:
    """Print the data and the protocol of a problem, draw the data, and judge them: enough or not,
    which order and delay, which experiment would help.

    Closed-loop records, parameters that no record can determine, and a simulator of your own are
    tested too, see `asia init --help`.
    """
    from asia.analysis.data_verdict import judge_data
    from asia.interfaces.workspace.workspace import is_workspace
    from asia.judge.evaluation.control import control_lines
    from asia.judge.evaluation.plant_check import check_plant
    from asia.plants.recognition import recognise, recognition_lines
    from asia.problem.check import check_problem
    from asia.problem.load import load_problem
    from asia.problem.seal import seal
    from asia.report.files import draw_problem
    from asia.search.run import check_baseline, level_here

    loaded = load_problem(problem)
    check_baseline(loaded)
    make_folds(loaded.train, loaded.protocol)
    in_workspace = is_workspace(Path(problem))
    for line in control_lines(loaded, level_here()) if loaded.control else ():
        say(line)
    # Of a control problem the rest is about the records from which models are identified.
    base = loaded.identification
    loaded = replace(base, name=loaded.name, description=loaded.description)
    report = check_problem(loaded, seal(loaded), in_workspace=in_workspace)
    simulator = check_plant(loaded, level_here()) if loaded.plant else []
    # A verdict needs a linear model.
    regular = loaded.channels.time_step is None
    verdict = judge_data(loaded, report).lines() if regular else []
    ranked = recognise(loaded.description, loaded.inputs, loaded.outputs, loaded.train)
    plants = recognition_lines(ranked) if regular and loaded.physics is None else []
    for line in (*report.lines(), *plants, *simulator, *verdict):
        say(line)
    if not draw:
        return
    failed: list[str] = []
    try:
        pictures = draw_problem(loaded, Path(runs) / "check" / loaded.name, failed)
    except OSError as error:
        say(
            f"note: could not draw into {runs}: {error.strerror or error}; "
            "give --runs DIR or set ASIA_RUNS",
            file=sys.stderr,
        )
        return
    for line in failed:
        say(f"note    {line}", file=sys.stderr)
    for path in pictures:
        if path.suffix == ".png":
            say(f"picture  {path}")
