"""A new problem directory from records in memory."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from asia.data.trajectory import Signal, Trajectory
from asia.errors import UserError
from asia.problem.budget import Budget
from asia.problem.create import check_directory, record_csv, write_directory
from asia.problem.load import least_samples, load_problem
from asia.problem.physics import Physics
from asia.problem.problem import Problem
from asia.problem.protocol import ProtocolRule
from asia.problem.protocol_table import groups_table, protocol_table
from asia.problem.schema import ProtocolTable
from asia.problem.symmetry import Symmetry
from asia.problem.toml import toml_text

Table = Mapping[str, Any]


@dataclass(frozen=True)
class ArrayProblem:
    """A problem in memory. Tables have the keys of problem.toml."""

    name: str
    """Part of the run's name."""
    train: tuple[Trajectory, ...]
    """Records to train on; each becomes a CSV file of its name."""
    test: tuple[Trajectory, ...]
    """Records of the test; () for none."""
    inputs: tuple[Signal, ...]
    """The inputs."""
    outputs: tuple[Signal, ...]
    """The outputs."""
    sampling_time: float
    """s."""
    description: str
    """The system in plain English; "" for none."""
    baseline: str | None
    """Source of the first candidate; None for the best linear model."""
    groups: Mapping[str, Sequence[str]] | None
    """Names of records that folds hold out together."""
    protocol: ProtocolRule | Table | None
    """Rule for V; None for the defaults."""
    budget: Budget | Table | None
    """Limits of the search; None for the defaults."""
    physics: Physics | Table | None
    """Equations; None for none."""
    symmetry: Symmetry | None = None
    """Changes of the signals that leave the laws as they are."""


def save_problem(given: ArrayProblem, directory: Path) -> Problem:
    """Write the problem directory, or verify that it holds the same files, and load it.

    Raises:
        UserError: for other files in the directory, with nothing overwritten, and for arguments
            that make no problem
    """
    directory = directory.resolve()
    files = _files(given)
    if (directory / "problem.toml").is_file():
        for name, text in files:
            path = directory / name
            if not path.is_file() or path.read_bytes() != text.encode():
                raise UserError(
                    f"{directory} holds another problem ({name} differs), and nothing is "
                    "overwritten: name another directory, or remove this one"
                )
    else:
        check_directory(directory)
        write_directory(directory, files)
    return load_problem(directory)


def least_segment(protocol: ProtocolRule | Table | None) -> int:
    """Return the samples of the shortest segment that the folds can divide; 1 for an invalid
    protocol, which loading the problem reports."""
    if protocol is None or isinstance(protocol, ProtocolRule):
        return least_samples(protocol or ProtocolRule())
    try:
        return least_samples(TypeAdapter(ProtocolTable).validate_python(_plain(protocol)).rule())
    except ValueError:
        return 1


def _files(given: ArrayProblem) -> list[tuple[str, str]]:
    records = (*given.train, *given.test)
    names = [signal.name for signal in (*given.inputs, *given.outputs)]
    files = [(f"{t.name}.csv", record_csv(t, names)) for t in records]
    if given.description:
        files.append(("description.md", given.description))
    if given.baseline is not None:
        files.append(("baseline.py", given.baseline))
    return [*files, ("problem.toml", toml_text(_tables(given)))]


def _tables(given: ArrayProblem) -> Table:
    groups = given.groups
    if groups is None and isinstance(given.protocol, ProtocolRule):
        groups = groups_table(given.protocol)
    return {
        "name": given.name,
        "description": "description.md" if given.description else None,
        "sampling_time": float(given.sampling_time),
        "inputs": [asdict(signal) for signal in given.inputs],
        "outputs": [asdict(signal) for signal in given.outputs],
        "data": {
            "train": [f"{t.name}.csv" for t in given.train],
            "test": [f"{t.name}.csv" for t in given.test],
            "groups": groups,
        },
        "protocol": _plain(
            protocol_table(given.protocol)
            if isinstance(given.protocol, ProtocolRule)
            else given.protocol
        ),
        "budget": _plain(given.budget),
        "physics": _plain(given.physics),
        "symmetry": {k: dict(v) for k, v in given.symmetry.items()} if given.symmetry else None,
    }


def _plain(value: Any) -> Any:
    """Tables and lists of Python's own numbers, at any depth."""
    if isinstance(value, (Budget, Physics)):
        return asdict(value)
    if isinstance(value, Mapping):
        return {key: _plain(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(entry) for entry in value]
    return value.item() if hasattr(value, "item") else value
