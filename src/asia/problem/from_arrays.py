"""A new problem directory from records in memory."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
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
from asia.problem.protocol_table import ProtocolTable, groups_table, protocol_table
from asia.problem.symmetry import Symmetry
from asia.problem.toml import toml_text

Table = Mapping[str, Any]


def save_problem(
    directory: Path,
    *,
    name: str | None,
    train: Sequence[Trajectory],
    test: Sequence[Trajectory],
    inputs: Sequence[Signal],
    outputs: Sequence[Signal],
    description: str,
    baseline: str | None,
    groups: Mapping[str, Sequence[str]] | None,
    protocol: ProtocolRule | Table | None,
    budget: Budget | Table | None,
    physics: Physics | Table | None,
    symmetry: Symmetry | None,
) -> Problem:
    """Write the problem directory, or verify that it holds the same files, and load it.

    Tables have the keys of problem.toml.

    Raises:
        UserError: for other files in the directory, with nothing overwritten, and for arguments
            that make no problem
    """
    directory = directory.resolve()
    names = [signal.name for signal in (*inputs, *outputs)]
    files = {f"{t.name}.csv": record_csv(t, names) for t in (*train, *test)}
    if description:
        files["description.md"] = description
    if baseline is not None:
        files["baseline.py"] = baseline
    if isinstance(protocol, ProtocolRule):
        groups = groups_table(protocol) if groups is None else groups
        protocol = protocol_table(protocol)
    tables = {
        "name": name or directory.name,
        "description": "description.md" if description else None,
        "sampling_time": float(train[0].sampling_time),
        "inputs": [asdict(signal) for signal in inputs],
        "outputs": [asdict(signal) for signal in outputs],
        "data": {
            "train": [f"{t.name}.csv" for t in train],
            "test": [f"{t.name}.csv" for t in test],
            "groups": groups,
        },
        "protocol": _plain(protocol),
        "budget": _plain(budget),
        "physics": _plain(physics),
        "symmetry": {k: dict(v) for k, v in symmetry.items()} if symmetry else None,
    }
    files["problem.toml"] = toml_text(tables)
    if (directory / "problem.toml").is_file():
        for file, text in files.items():
            path = directory / file
            if not path.is_file() or path.read_bytes() != text.encode():
                raise UserError(
                    f"{directory} holds another problem ({file} differs), and nothing is "
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


def _plain(value: Any) -> Any:
    """Tables and lists of Python's own numbers, at any depth."""
    if isinstance(value, (Budget, Physics)):
        return asdict(value)
    if isinstance(value, Mapping):
        return {key: _plain(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(entry) for entry in value]
    return value.item() if hasattr(value, "item") else value
