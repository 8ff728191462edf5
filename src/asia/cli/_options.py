"""Options that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

Runs = Annotated[
    Path, typer.Option("--runs", envvar="ASIA_RUNS", help="Directory that holds the runs.")
]
RunName = Annotated[
    str | None, typer.Argument(metavar="[RUN]", help="Path or name; the newest when left out.")
]
Json = Annotated[bool, typer.Option("--json", help="JSON on stdout, all else on stderr.")]
Keys = Annotated[
    Path | None,
    typer.Option(
        "--keys",
        help="Folder of the keys of sealed tests; default ASIA_KEYS, else ~/.config/asia/keys.",
    ),
]
YesProcess = Annotated[
    bool,
    typer.Option(
        "--yes-process", help="Open the test though level process kept no candidate off it."
    ),
]
ProblemName = Annotated[
    str, typer.Argument(metavar="PROBLEM", help="Built-in name, or a directory with problem.toml.")
]
Experiments = Annotated[
    int | None, typer.Option(min=1, help="Candidates to evaluate, the baseline included.")
]
Seed = Annotated[int, typer.Option(min=0, help="Seed of the search.")]
Hours = Annotated[
    float | None, typer.Option(help="Start no experiment after this many hours of evaluation.")
]
Name = Annotated[str | None, typer.Option(help="Name of the run; default PROBLEM-AGENT-sSEED.")]
EarlyStopping = Annotated[
    str | None,
    typer.Option(help="inner, or validation (V is then not leak-free); default the problem's."),
]
IsolationLevel = Annotated[
    str | None, typer.Option(help="Ask for a level instead of the strongest: landlock or process.")
]
MORE = "More commands"
DEFAULT_RUNS = Path("runs")
