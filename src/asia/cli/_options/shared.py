"""Options that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

Runs = Annotated[
    Path, typer.Option("--runs", envvar="ASIA_RUNS", help="Directory that holds the runs.")
]
RunName = Annotated[
    str | None,
    typer.Argument(
        metavar="[RUN]", help="Path or name; default: the run of this workspace, else the newest."
    ),
]
Json = Annotated[bool, typer.Option("--json", help="JSON on stdout, everything else on stderr.")]
Profile = Annotated[
    bool, typer.Option("--profile", help="Also print the time of each activity of the search.")
]
Keys = Annotated[
    Path | None,
    typer.Option(
        "--keys",
        help="Folder with the keys of sealed tests; default ASIA_KEYS, else ~/.config/asia/keys.",
    ),
]
YesProcess = Annotated[
    bool,
    typer.Option(
        "--yes-process", help="Open the test, although candidates at level process could read it."
    ),
]
ProblemName = Annotated[
    str,
    typer.Argument(
        metavar="PROBLEM",
        help="Built-in name (two_tanks_sim, bouc_wen, cascaded_tanks, ced, emps, f16, "
        "fine_steering_mirror, nanodrone, parallel_wiener_hammerstein, silverbox, "
        "wiener_hammerstein), or a directory with "
        "problem.toml.",
    ),
]
Time = Annotated[
    str | None, typer.Option(help='Column with the time stamps; "none": do not use any.')
]
TimeUnit = Annotated[
    str | None, typer.Option(help="Unit of time stamps that are numbers: s, ms, us, ns, days.")
]
ColumnNames = Annotated[
    list[str] | None, typer.Option(help="Column names of files without a header, in order.")
]
Experiment = Annotated[
    str | None, typer.Option(help="Column that names the experiment: each becomes a record.")
]
DEFAULT_RUNS = Path("runs")
