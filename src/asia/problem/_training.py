"""Training view of a problem: its training records, never its test."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict

from asia.problem._problem import Problem
from asia.problem._protocol import groups_table, protocol_table
from asia.problem._toml import toml_text

_HEADER = (
    "# Written by ASIA: the problem that candidates are judged on, with its training records.\n"
    "# A change in here changes nothing but what your own tools compute.\n"
)


def training_text(problem: Problem, names: Sequence[str]) -> str:
    """problem.toml over CSV files `data/NAME.csv`, a name for each training record in their order;
    `load_problem` gives the same records, folds and metric. It names neither test nor source."""
    called = {t.name: name for t, name in zip(problem.train, names, strict=True)}
    groups = groups_table(problem.protocol) or {}
    budget = problem.budget
    tables = {
        "name": problem.name,
        "sampling_time": problem.sampling_time,
        "inputs": [asdict(s) for s in problem.inputs],
        "outputs": [asdict(s) for s in problem.outputs],
        "data": {
            "train": [f"data/{name}.csv" for name in names],
            "groups": {k: [called[name] for name in v] for k, v in groups.items()} or None,
        },
        "protocol": protocol_table(problem.protocol),
        "budget": {"fit_seconds": budget.fit_seconds, "memory_mb": budget.memory_mb},
        "physics": None if problem.physics is None else asdict(problem.physics),
        "symmetry": {k: dict(v) for k, v in problem.symmetry.items()} or None,
    }
    return _HEADER + toml_text(tables)
