"""Questions of asia init on a terminal; the columns found in the files are the defaults."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from asia._text import say
from asia.errors import UserError

if TYPE_CHECKING:
    from asia.data.intake.survey import FileColumns
    from asia.problem.load import Wanted


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
    from asia.data.intake.survey import record_files, split_names

    if not asks:
        raise UserError("--train is missing: name the files with training records")
    train, _ = record_files(Path())
    text = typer.prompt("Files with training records", default=_joined(train) or None)
    chosen = [Path(name) for name in split_names(text, [str(p) for p in train])]
    return replace(given, train=chosen)


def _with_test(given: InitAnswers, wanted: Wanted) -> InitAnswers:
    """Ask for the test: experiments of the training files, or else files."""
    from asia.data.intake.survey import experiments_in, record_files, split_names

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
    from asia.data.intake.survey import split_names

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
    from asia.data.intake.survey import survey

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
    from asia.data.intake.survey import split_names

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
