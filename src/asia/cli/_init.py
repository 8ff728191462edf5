"""asia init: a problem from files of records."""

from __future__ import annotations

import sys
from collections.abc import Callable
from math import inf
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING, Annotated

import typer

from asia._text import say
from asia.cli._asking import InitAnswers, completed, split_at_commas
from asia.cli._options.shared import ColumnNames, Experiment, Keys, Time, TimeUnit
from asia.errors import UserError

if TYPE_CHECKING:
    from asia.problem.load import NewProblem

SEAL_FRACTION = 0.2
_SILENT_SECONDS = 2.0
BRIEF_HELP = frozenset(
    {"name", "train", "test", "inputs", "outputs", "sampling_time", "seal", "time", "yes"}
)
LISTS = ("--train", "--test", "--inputs", "--outputs", "--columns", "--test-experiments")


Train = Annotated[
    list[Path] | None, typer.Option(help="Files with training records. Asked for on a terminal.")
]
Inputs = Annotated[list[str] | None, typer.Option(help="Input columns. Asked for on a terminal.")]
Outputs = Annotated[list[str] | None, typer.Option(help="Output columns. Asked for on a terminal.")]
Yes = Annotated[
    bool,
    typer.Option("--yes", help="Ask nothing: use the detected columns, and seal a test."),
]
Step = Annotated[
    float | None,
    typer.Option(help="Sampling time in seconds, above 0. Default: from the time stamps."),
]
Sealed = Annotated[
    bool | None,
    typer.Option(
        "--seal/--no-seal",
        help="Move the test records into an encrypted store; without --test, the last 20 % of each "
        "record.",
    ),
]
TestExperiments = Annotated[
    list[str] | None,
    typer.Option(help="Names of the experiments in the training files that are the test."),
]

Delay = Annotated[
    str | None,
    typer.Option(help='Samples to delay the inputs by; "auto": from correlations. [preprocess]'),
]
Decimate = Annotated[int, typer.Option(help="Keep every Nth sample. [preprocess]")]
Detrend = Annotated[
    bool,
    typer.Option("--detrend", help="Subtract the training mean from every signal. [preprocess]"),
]
Scale = Annotated[
    bool,
    typer.Option("--scale", help="Divide every signal by its standard deviation. [preprocess]"),
]


def init(
    name: Annotated[Path, typer.Argument(help="Directory to make; its name is the problem's.")],
    train: Train = None,
    inputs: Inputs = None,
    outputs: Outputs = None,
    sampling_time: Step = None,
    test: Annotated[list[Path] | None, typer.Option(help="Test records.")] = None,
    seal: Sealed = None,
    time: Time = None,
    time_unit: TimeUnit = None,
    columns: ColumnNames = None,
    experiment_column: Experiment = None,
    test_experiments: TestExperiments = None,
    delay: Delay = None,
    decimate: Decimate = 1,
    detrend: Detrend = False,
    scale: Scale = False,
    keys: Keys = None,
    yes: Yes = False,
) -> None:
    """Write a minimal problem: asia init NAME --train a.csv --inputs u --outputs y"""
    from asia.problem.load import Preparation, Wanted, init_problem, key_folder

    named = tuple(split_at_commas(columns or ()))
    wanted = Wanted((), (), time, time_unit, experiment_column, named, _progress())
    if sampling_time is not None and not 0 < sampling_time < inf:
        raise UserError(
            f"--sampling-time is {sampling_time:g}: expected a number of seconds above 0"
        )
    given = InitAnswers(
        train or [],
        test or [],
        inputs or [],
        outputs or [],
        sampling_time,
        seal,
        test_experiments or [],
    )
    answers = completed(given, wanted, yes=yes)
    if answers.seal:
        from asia.search import check_hidden_from_workers

        check_hidden_from_workers(key_folder(keys))
    made = init_problem(
        name,
        train=answers.train,
        test=answers.test,
        inputs=answers.inputs,
        outputs=answers.outputs,
        sampling_time=answers.sampling_time,
        test_experiments=answers.test_experiments,
        seal_fraction=SEAL_FRACTION if answers.seal and not answers.has_test else None,
        seal=bool(answers.seal),
        keys=keys,
        wanted=wanted,
        preparation=Preparation(delay, decimate, detrend, scale),
    )
    _print_made(made, name, has_test=answers.has_test)


def _progress() -> Callable[[str], None]:
    """Return a callback that prints progress at most every two seconds."""
    said = monotonic()

    def tell(text: str) -> None:
        nonlocal said
        if monotonic() - said > _SILENT_SECONDS:
            said = monotonic()
            say(text, file=sys.stderr)

    return tell


def _print_made(made: NewProblem, name: Path, *, has_test: bool) -> None:
    for text in made.read:
        say(f"read     {text}")
    say(f"wrote    {made.path}")
    if made.store is not None:
        _print_sealed(made, "the test records" if has_test else "the last 20 % of each record")
    elif has_test:
        say("note     the test files are not encrypted; --seal encrypts them")
    else:
        say("note     no test data. --seal holds out the last 20 % of each record as the test")
    say(f"next     describe the system in {made.path.parent / 'description.md'}")
    say(f"         asia check {name}")
    say(f"         asia run {name}")


def _print_sealed(made: NewProblem, what: str) -> None:
    from asia.problem.load import key_folder

    say(f"sealed   {what}, encrypted, in {made.store}; the search will not see it")
    say(f"key      {made.key}: keep a copy elsewhere; the test cannot be opened without it")
    if made.key is not None and made.key.parent != key_folder():
        say(
            f"note     set ASIA_KEYS={made.key.parent} when you search, so that no agent "
            "sees that folder"
        )
    for path in made.removed:
        say(f"removed  {path}")
    if made.removed:
        say("note     disks, backups, snapshots and version control may keep copies of these files")
    for note in made.notes:
        say(f"note     {note}")
