"""asia init: a problem from files of records."""

from __future__ import annotations

import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import inf
from pathlib import Path
from textwrap import wrap
from time import monotonic
from typing import TYPE_CHECKING, Annotated

import typer

from asia._text import say
from asia.data.preprocess import Preparation
from asia.errors import UserError
from asia.interfaces.cli.options import (
    ColumnNames,
    Experiment,
    Keys,
    Time,
    TimeUnit,
)

if TYPE_CHECKING:
    from asia.data.intake.sheet import Wanted
    from asia.plants.catalogue import Plant


# Questions of asia init on a terminal; the columns found in the files are the defaults.


@dataclass(frozen=True)
class InitAnswers:
    """Files, columns and test of a new problem, as options and as answers."""

    train: Annotated[list[Path], "Files with training records. Asked for on a terminal."] = field(
        default_factory=list[Path]
    )
    inputs: Annotated[list[str], "Input columns. Asked for on a terminal."] = field(
        default_factory=list[str]
    )
    outputs: Annotated[list[str], "Output columns. Asked for on a terminal."] = field(
        default_factory=list[str]
    )
    sampling_time: Annotated[
        float | None, "Sampling time in seconds, above 0. Default: from the time stamps."
    ] = None
    test: Annotated[list[Path], "Test records."] = field(default_factory=list[Path])
    seal: Annotated[
        bool | None,
        "Move the test records into an encrypted store; without --test, the last 20 % of each "
        "record.",
    ] = None
    test_experiments: Annotated[
        list[str], "Names of the experiments in the training files that are the test."
    ] = field(default_factory=list[str])
    references: list[str] = field(default_factory=list[str])
    """Columns that look like references of a control loop."""

    @property
    def has_test(self) -> bool:
        """Tell whether test records are named."""
        return bool(self.test or self.test_experiments)


def completed(given: InitAnswers, wanted: Wanted, *, yes: bool) -> InitAnswers:
    """Complete the answers: ask on a terminal, or take the defaults with `yes`. Raises UserError if
    neither is possible."""
    from asia.data.intake.conversion import record_files, split_names

    asks = sys.stdin.isatty() and not yes
    answers = given
    if not given.train:
        if not asks:
            raise UserError("--train is missing: name the files with training records")
        train, _ = record_files(Path())
        text = typer.prompt("Files with training records", default=_joined(train) or None)
        chosen = [Path(name) for name in split_names(text, [str(p) for p in train])]
        answers = replace(given, train=chosen)
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
    else:
        answers = _with_references(answers)
    if not answers.has_test and answers.seal is None:
        seal = True if yes else None
        if asks:
            question = "No test records. Seal the last 20 % of each record as the test?"
            seal = typer.confirm(question, default=True)
        answers = replace(answers, seal=seal)
    return answers


def _with_test(given: InitAnswers, wanted: Wanted) -> InitAnswers:
    """Ask for the test: experiments of the training files, or else files."""
    from asia.data.intake.conversion import experiments_in, record_files, split_names

    known = experiments_in(given.train, wanted)
    if len(known) > 1:
        say(f"experiments: {', '.join(known)}")
        while True:
            text = typer.prompt('Experiments for the test ("none" without)', default="none")
            if text.strip() == "none":
                break
            names = split_names(text, known)
            unknown = [name for name in names if name not in known]
            if names and not unknown:
                return replace(given, test_experiments=names)
            say(f"no '{unknown[0]}'; there are {', '.join(known)}" if unknown else "")
    used = {path.resolve() for path in given.train}
    tests = [path for path in record_files(Path())[1] if path.resolve() not in used]
    while True:
        question = 'Files with test records ("none" without)'
        text = typer.prompt(question, default=_joined(tests) or "none")
        if text.strip() == "none":
            return given
        paths = [Path(name) for name in split_names(text, [str(p) for p in tests])]
        missing = [path for path in paths if not path.exists()]
        if paths and not missing:
            return replace(given, test=paths)
        say(f"no such file: {missing[0]}" if missing else "")


def _with_columns(answers: InitAnswers, wanted: Wanted, *, asks: bool) -> InitAnswers:
    from asia.data.intake.conversion import split_names, survey

    found = survey(answers.train[0], wanted)

    def columns(title: str, default: Sequence[str], refused: Mapping[str, str]) -> list[str]:
        if not asks:
            if not default:
                raise UserError(f"no column is suitable for the {title.lower()}: name the columns")
            say(f"{title.lower():<8} {', '.join(default)}")
            return list(default)
        while True:
            text = typer.prompt(title, default=", ".join(default) or None)
            names = split_names(text, found.names)
            unknown = [name for name in names if name not in found.names]
            bad = [name for name in names if name in refused]
            if names and not unknown and not bad:
                return names
            if unknown:
                say(f"no column '{unknown[0]}'; there are {', '.join(found.names)}")
            elif bad:
                say(f"'{bad[0]}' {refused[bad[0]]}: name another column")

    if asks:
        times = f"; sample times in {found.time}" if found.time else ""
        say(f"{answers.train[0]} has {', '.join(found.names)}{times}")
        for name, reason in found.unusable.items():
            say(f"{name} {reason}")
    outputs = answers.outputs or [n for n in found.outputs if n not in answers.inputs]
    inputs = answers.inputs or [n for n in found.inputs if n not in outputs]
    if not answers.inputs:
        inputs = columns("Inputs", inputs, {})
    if not answers.outputs:
        outputs = columns("Outputs", [n for n in outputs if n not in inputs], found.unusable)
    step = answers.sampling_time
    if step is None and not found.timed and asks:
        question = "No time stamps were found. Sampling time in seconds"
        while True:
            step = typer.prompt(question, type=float)
            if 0 < step < inf:
                break
            say("expected a number above 0")
    done = replace(answers, inputs=inputs, outputs=outputs, sampling_time=step)
    return _with_references(done)


def _with_references(answers: InitAnswers) -> InitAnswers:
    """Find columns that look like references and are in every training file."""
    from asia.data.intake.conversion import references_among
    from asia.data.intake.formats import file_format

    named = {*answers.inputs, *answers.outputs}
    known: list[str] | None = None
    for path in answers.train:
        try:
            columns = references_among(file_format(path).columns(path))
        except UserError:  # The reader of the records says what is wrong.
            return answers
        known = [n for n in columns if n not in named and (known is None or n in known)]
    return replace(answers, references=known or [])


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
    | {"description", "like"}
)
LISTS = (
    "--train",
    "--test",
    "--inputs",
    "--outputs",
    "--columns",
    "--test-experiments",
    "--missing-code",
)


def init(
    *,
    name: Annotated[Path, typer.Argument(help="Directory to make; its name is the problem's.")],
    answers: InitAnswers,
    time: Time = None,
    time_unit: TimeUnit = None,
    columns: ColumnNames = None,
    experiment_column: Experiment = None,
    missing_code: Annotated[
        list[float] | None,
        typer.Option(help="Values that mark missing samples, such as 999.9. [[data.missing]]"),
    ] = None,
    preparation: Preparation,
    description: Annotated[
        str | None, typer.Option(help="The system in plain English, for description.md.")
    ] = None,
    like: Annotated[
        str | None,
        typer.Option(
            help="Plant of the catalogue whose equations problem.toml gets; without --train that "
            "of an existing problem."
        ),
    ] = None,
    keys: Keys = None,
    yes: Annotated[
        bool, typer.Option("--yes", help="Ask nothing: use the detected columns, and seal a test.")
    ] = False,
) -> None:
    """Write a minimal problem: asia init NAME --train a.csv --inputs u --outputs y. Its
    problem.toml also takes equations, a simulator of your own, closed-loop records and frequency
    responses.

    Tables and keys to add; problem.toml has examples as comments:

    - `[loop]`, records from a closed loop: `reference` (its column, no input), `enters`
      ("controller" or "plant"), `controller` (numerator and denominator in z),
      `inputs` ("measured", or "explained" for stable plants)
    - `[plant]`, a simulator of your own: `source` ("plant.py:simulate" or "model.fmu"),
      `[plant.parameters]` and `[plant.initial]` (min, max, unit). The function is
      `simulate(u, params, x0, dt)`: u (samples, inputs), params and x0 by name, dt in s; it returns
      the outputs (samples, outputs), or (samples,) for one
    - `[physics]`, equations: `states`, `parameters` (min, max), `constants`, `definitions`,
      `dynamics` (d/dt), `observation`, `bounds`, `priors`, `corrections`
    - `[data] frequency`, files with measured frequency responses
    - `role` of an input: "disturbance" (nobody sets it), "scheduling" (gain and poles follow it) or
      "time_step" (irregular samples)

    docs/problem.md and docs/use/simulator.md, in a clone of ASIA, say more.
    """
    from asia.data.intake.sheet import Missing, Wanted
    from asia.data.store import key_folder
    from asia.plants.catalogue import plant_named
    from asia.problem.create import init_problem

    plant = None if like is None else plant_named(like)
    if plant is not None and not answers.train and (name / "problem.toml").is_file():
        _write_equations(name / "problem.toml", plant)
        return
    printed = monotonic()

    def progress(text: str) -> None:
        """Print at most every two seconds."""
        nonlocal printed
        if monotonic() - printed > _SILENT_SECONDS:
            printed = monotonic()
            say(text, file=sys.stderr)

    named = tuple(split_at_commas(columns or ()))
    missing = tuple(Missing(code=code) for code in missing_code or ())
    wanted = Wanted((), (), time, time_unit, experiment_column, named, missing, progress)
    step = answers.sampling_time
    if step is not None and not 0 < step < inf:
        raise UserError(f"--sampling-time is {step:g}: expected a number of seconds above 0")
    answers = completed(answers, wanted, yes=yes)
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
        preparation=preparation,
        references=answers.references,
    )
    if description is not None:
        (made.path.parent / "description.md").write_text(f"{description}\n", encoding="utf-8")
    for text in made.read:
        say(f"read     {text}")
    for one in made.bad:
        say(f"doubt    {one}")
    say(f"wrote    {made.path}")
    if answers.references:
        say(
            f"note     {', '.join(answers.references)} looks like the reference of a closed loop, "
            "so it is no input: if a controller moved the inputs, remove the # of [loop] in "
            "problem.toml"
        )
    if made.store is not None:
        sealed = "the test records" if answers.has_test else "the last 20 % of each record"
        say(f"sealed   {sealed}, encrypted, in {made.store}; the search will not see it")
        say(f"key      {made.key}: keep a copy elsewhere; the test cannot be opened without it")
        if made.key is not None and made.key.parent != key_folder():
            say(
                f"note     set ASIA_KEYS={made.key.parent} when you search, so that no agent "
                "sees that folder"
            )
        for path in made.removed:
            say(f"removed  {path}")
        if made.removed:
            say(
                "note     disks, backups, snapshots and version control may keep copies of these "
                "files"
            )
        for note in made.notes:
            say(f"note     {note}")
    elif answers.has_test:
        say("note     the test files are not encrypted; --seal encrypts them")
    else:
        say("note     no test data. --seal holds out the last 20 % of each record as the test")
    _liken(made.path, plant, asks=sys.stdin.isatty() and not yes)
    if description is None:
        say(f"next     describe the system in {made.path.parent / 'description.md'}")
    say(f"next     asia check {name}")
    say(f"         asia run {name}")


def _liken(path: Path, plant: Plant | None, *, asks: bool) -> None:
    """Write the equations of a plant, or say which plant a new problem looks like."""
    from asia.plants.recognition import likely, recognise, recognition_lines
    from asia.problem.load import load_problem

    if plant is None:
        problem = load_problem(path)
        found = likely(
            recognise(problem.description, problem.inputs, problem.outputs, problem.train)
        )
        for line in recognition_lines(found) if found else ():
            say(line)
        question = "Write the equations of the first into problem.toml?"
        if not (found and asks and typer.confirm(question, default=False)):
            return
        plant = found[0].plant
    _write_equations(path, plant)


def _write_equations(path: Path, plant: Plant) -> None:
    """Write `[physics]` of a plant into a problem file."""
    from asia.ledger.chain import write_whole
    from asia.plants.recognition import assignments
    from asia.problem.load import load_problem
    from asia.problem.physics_text import written_physics

    problem = load_problem(path)
    if problem.physics is not None:
        raise UserError(f"{path} has equations: remove [physics] to write those of {plant.name}")
    found = assignments(plant, problem.inputs, problem.outputs)
    if not found:
        roles = "; ".join(
            f"{what}: {', '.join(names)}"
            for what, names in (("inputs", plant.entry.inputs), ("outputs", plant.entry.outputs))
        )
        raise UserError(
            f"the signals of {path} cannot fill the roles of a {plant.title} ({roles}): check "
            "inputs, outputs and their units"
        )
    physics = plant.physics(found[0], problem.inputs, problem.outputs, problem.train)
    before = path.read_text(encoding="utf-8")
    # The example of `asia init` goes, what the user wrote behind it stays.
    text = re.sub(r"^# \[physics\](.*\n?)(#.*\n?)*", "", before, flags=re.MULTILINE)
    comments = [f"{plant.title}. {plant.entry.unknown}", f"Source: {plant.entry.source}."]
    lines = [f"# {line}" for comment in comments for line in wrap(comment, 98)]
    equations = written_physics(physics, "physics.")
    written = "\n".join([text.rstrip(), "", *lines, "[physics]", equations])
    write_whole(path, written.encode())
    try:
        load_problem(path)
    except UserError:
        write_whole(path, before.encode())
        raise
    signals = ", ".join(f"{role} is {name}" for role, name in found[0].items())
    say(f"wrote    the equations of a {plant.title} into {path}: {signals}")
    for other in found[1:]:
        signals = ", ".join(f"{role} is {name}" for role, name in other.items())
        say(f"note     the names tell as little about: {signals}")
