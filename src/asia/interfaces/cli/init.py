"""asia init: a problem from files of records."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import inf
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING, Annotated

import typer

from asia._text import say
from asia.errors import UserError
from asia.interfaces.cli.options import ColumnNames, Experiment, Keys, Time, TimeUnit

if TYPE_CHECKING:
    from asia.data.intake.records import FileColumns
    from asia.data.intake.sheet import Wanted
    from asia.problem.create import NewProblem


# Questions of asia init on a terminal; the columns found in the files are the defaults.


@dataclass(frozen=True)
class InitAnswers:
    """Files, columns and test of a new problem."""

    train: list[Path]
    test: list[Path]
    inputs: list[str]
    outputs: list[str]
    sampling_time: float | None
    """s; None: found from the time stamps."""
    seal: bool | None
    """None: not decided."""
    test_experiments: list[str] = field(default_factory=list[str])
    """Experiments in the training files that are the test."""

    @property
    def has_test(self) -> bool:
        """Tell whether test records are named."""
        return bool(self.test or self.test_experiments)


def completed(given: InitAnswers, wanted: Wanted, *, yes: bool) -> InitAnswers:
    """Complete the answers: ask on a terminal, or take the defaults with `yes`. Raises UserError if
    neither is possible."""
    asks = sys.stdin.isatty() and not yes
    answers = given
    if not given.train:
        answers = _with_files(given, asks=asks)
    if asks and not answers.has_test and given.seal is None:
        answers = _with_test(answers, wanted)
    answers = replace(
        answers, inputs=split_at_commas(answers.inputs), outputs=split_at_commas(answers.outputs)
    )
    if not answers.inputs or not answers.outputs:
        if not asks and not yes:
            missing = "--inputs" if not answers.inputs else "--outputs"
            raise UserError(
                f"{missing} is missing: name the columns, or accept the detected ones with --yes"
            )
        answers = _with_columns(answers, wanted, asks=asks)
    if not answers.has_test and answers.seal is None:
        answers = replace(answers, seal=_sealed(asks=asks, yes=yes))
    return answers


def _with_files(given: InitAnswers, *, asks: bool) -> InitAnswers:
    from asia.data.intake.records import record_files, split_names

    if not asks:
        raise UserError("--train is missing: name the files with training records")
    train, _ = record_files(Path())
    text = typer.prompt("Files with training records", default=_joined(train) or None)
    chosen = [Path(name) for name in split_names(text, [str(p) for p in train])]
    return replace(given, train=chosen)


def _with_test(given: InitAnswers, wanted: Wanted) -> InitAnswers:
    """Ask for the test: experiments of the training files, or else files."""
    from asia.data.intake.records import experiments_in, record_files, split_names

    known = experiments_in(given.train, wanted)
    if len(known) > 1:
        say(f"experiments: {', '.join(known)}")
        names = _chosen('Experiments for the test ("none" without)', "none", known)
        if names:
            return replace(given, test_experiments=names)
    used = {path.resolve() for path in given.train}
    tests = [path for path in record_files(Path())[1] if path.resolve() not in used]
    question = 'Files with test records ("none" without)'
    while True:
        text = typer.prompt(question, default=_joined(tests) or "none")
        if text.strip() == "none":
            return given
        paths = [Path(name) for name in split_names(text, [str(p) for p in tests])]
        missing = [path for path in paths if not path.exists()]
        if paths and not missing:
            return replace(given, test=paths)
        say(f"no such file: {missing[0]}" if missing else "")


def _chosen(question: str, default: str, known: Sequence[str]) -> list[str]:
    from asia.data.intake.records import split_names

    while True:
        text = typer.prompt(question, default=default)
        if text.strip() == "none":
            return []
        names = split_names(text, known)
        unknown = [name for name in names if name not in known]
        if names and not unknown:
            return names
        say(f"no '{unknown[0]}'; there are {', '.join(known)}" if unknown else "")


def _with_columns(answers: InitAnswers, wanted: Wanted, *, asks: bool) -> InitAnswers:
    from asia.data.intake.records import survey

    found = survey(answers.train[0], wanted)
    if asks:
        times = f"; sample times in {found.time}" if found.time else ""
        say(f"{answers.train[0]} has {', '.join(found.names)}{times}")
        for name, reason in found.unusable.items():
            say(f"{name} {reason}")
    outputs = answers.outputs or [n for n in found.outputs if n not in answers.inputs]
    inputs = answers.inputs or [n for n in found.inputs if n not in outputs]
    if not answers.inputs:
        inputs = _columns("Inputs", inputs, found, asks=asks, refused={})
    if not answers.outputs:
        left = [n for n in outputs if n not in inputs]
        outputs = _columns("Outputs", left, found, asks=asks, refused=found.unusable)
    step = answers.sampling_time
    if step is None and not found.timed and asks:
        step = _sampling_time()
    return replace(answers, inputs=inputs, outputs=outputs, sampling_time=step)


def _columns(
    what: str,
    default: Sequence[str],
    found: FileColumns,
    *,
    asks: bool,
    refused: Mapping[str, str],
) -> list[str]:
    from asia.data.intake.records import split_names

    if not asks:
        if not default:
            raise UserError(f"no column is suitable for the {what.lower()}: name the columns")
        say(f"{what.lower():<8} {', '.join(default)}")
        return list(default)
    while True:
        text = typer.prompt(what, default=", ".join(default) or None)
        names = split_names(text, found.names)
        unknown = [name for name in names if name not in found.names]
        bad = [name for name in names if name in refused]
        if names and not unknown and not bad:
            return names
        if unknown:
            say(f"no column '{unknown[0]}'; there are {', '.join(found.names)}")
        elif bad:
            say(f"'{bad[0]}' {refused[bad[0]]}: name another column")


def _sampling_time() -> float:
    while True:
        step: float = typer.prompt(
            "No time stamps were found. Sampling time in seconds", type=float
        )
        if 0 < step < inf:
            return step
        say("expected a number above 0")


def _sealed(*, asks: bool, yes: bool) -> bool | None:
    if asks:
        question = "No test records. Seal the last 20 % of each record as the test?"
        return typer.confirm(question, default=True)
    return True if yes else None


def split_at_commas(names: Sequence[str]) -> list[str]:
    """Names of columns, one or several in each word."""
    return [part.strip() for name in names for part in name.split(",") if part.strip()]


def _joined(paths: Sequence[Path]) -> str:
    return ", ".join(map(str, paths))


# asia init: a problem from files of records.


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
    from asia.data.intake.sheet import Wanted
    from asia.data.store import key_folder
    from asia.problem.create import Preparation, init_problem

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
        from asia.search.run import check_hidden_from_workers

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
    from asia.data.store import key_folder

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
