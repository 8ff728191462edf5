"""Resolved problem of a run: its text, its digests, and changes since."""

from __future__ import annotations

import hashlib
import json
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from asia.data.trajectory import Trajectory, data_digest
from asia.errors import UserError
from asia.problem.feedback import loop_table
from asia.problem.physics import Physics
from asia.problem.problem import Problem, Seal
from asia.problem.protocol import ProtocolRule
from asia.problem.protocol_table import groups_table, protocol_table
from asia.problem.schema import DigestTable
from asia.problem.symmetry import Symmetry
from asia.problem.toml import toml_text

# sha256 digests of the inputs of a search.


def protocol_digest(problem: Problem) -> str:
    """Return the sha256 (hex) of the protocol with its defaults filled in.

    Absent settings do not count, so that a digest survives additions to the rules.
    """
    rule = asdict(problem.protocol)
    if problem.protocol.residuals == ProtocolRule.residuals:
        del rule["residuals"]
    return _json_digest(_present(rule))


def physics_digest(physics: Physics) -> str:
    """Hex sha256 of the equations, ranges, bounds, and the priors and corrections there are."""
    # These count only where they hold something: a digest outlives additions to the rules.
    later = ("priors", "corrections")
    return _json_digest({k: v for k, v in asdict(physics).items() if v or k not in later})


def symmetry_digest(symmetry: Symmetry) -> str:
    """Hex sha256 of the generators."""
    return _json_digest({name: dict(generator) for name, generator in symmetry.items()})


def text_digest(text: str) -> str:
    """Hex sha256 of the text as UTF-8."""
    return hashlib.sha256(text.encode()).hexdigest()


def _present(value: Any) -> Any:
    """Leave out the entries of mappings that are None or an empty tuple."""
    if isinstance(value, dict):
        return {k: _present(v) for k, v in value.items() if v is not None and v != ()}
    if isinstance(value, tuple):
        return [_present(v) for v in value]
    return value


def _json_digest(value: Any) -> str:
    return text_digest(json.dumps(value, sort_keys=True))


# Lock file: the resolved problem of a run as text, and the changes since.


_HEADER = "# Written by ASIA when the run began. A change in here, or in the data, ends the run.\n"
_TEXTS = ("description", "notes", "strategies", "baseline")


@dataclass(frozen=True)
class Difference:
    """A key of the lock, its value there and its value now; None is absent."""

    key: str
    before: Any
    now: Any

    def __str__(self) -> str:
        if self.key.startswith("digests."):
            return f"{self.key.removeprefix('digests.')} changed"
        return f"{self.key} was {self.before!r}, is {self.now!r}"


def lock_text(problem: Problem, seal: Seal) -> str:
    """TOML with absolute data paths, defaults filled in, texts and digests.

    `load_lock` restores the problem from it.
    """
    # Scenarios are drawn again; the rest of a control problem is its identification problem.
    control, base = problem.control, problem.identification
    plant = (control or problem).plant
    test = base.test.source
    data = {**base.data.to_toml(), **(test.to_toml() if test else {})}
    guard = data.pop("guard", None)
    tables = {
        "name": problem.name,
        "description": problem.description,
        "notes": problem.notes or None,
        "strategies": problem.strategies or None,
        "baseline": problem.baseline,
        "sampling_time": base.channels.sampling_time,
        "inputs": [asdict(s) for s in base.channels.inputs],
        "outputs": [asdict(s) for s in base.channels.outputs],
        "data": {
            **data,
            "groups": groups_table(base.protocol),
            "guard": guard,
            "guard_share": base.guard_share,
            "period": base.period,
            "frequency": [str(path) for path in base.response_files] or None,
        },
        "protocol": protocol_table(base.protocol),
        "budget": asdict(problem.budget),
        "physics": None if base.physics is None else asdict(base.physics),
        "plant": plant and plant.table,
        "control": control and control.toml(),
        "preprocess": asdict(base.preprocess) if base.preprocess else None,
        "symmetry": {k: dict(v) for k, v in base.symmetry.items()} or None,
        "loop": loop_table(base.loop),
        "digests": {**_digests(problem, seal.sha256), "guard": seal.guard},
    }
    return _HEADER + toml_text(tables)


def lock_differences(problem: Problem, seal: Seal, path: Path) -> tuple[Difference, ...]:
    """Return the differences between a problem and the lock at `path`.

    The location of files does not count, their values do.

    Raises:
        UserError: when the lock cannot be read
    """
    try:
        before = dict(_flat(tomllib.loads(path.read_text(encoding="utf-8"))))
    except (OSError, ValueError, RecursionError) as error:
        raise UserError(f"cannot read {path}: {error}") from error
    now = dict(_flat(tomllib.loads(lock_text(problem, seal))))
    moved = {
        "data.train", "data.test", "data.guard", "data.frequency", "data.sealed.file",
        "plant.source", *_TEXTS,
    }  # fmt: skip
    keys = [k for k in {**before, **now} if k not in moved and before.get(k) != now.get(k)]
    return tuple(Difference(k, before.get(k), now.get(k)) for k in keys)


def check_digests(problem: Problem, expected: DigestTable, path: Path) -> None:
    """Raise UserError that names every part whose digest is not the expected one."""
    found = _digests(problem, None)
    parts = (*_TEXTS, "physics", "plant", "control", "symmetry", "protocol", "frequency")
    names = {"frequency": "frequency responses"}
    changed = [
        f"the {names.get(part, part)}" for part in parts if found[part] != getattr(expected, part)
    ]
    train = found["train"]
    if len(train) != len(expected.train):
        changed.append("the number of training records")
    else:
        pairs = zip(_records(problem), train, expected.train, strict=True)
        changed += [f"training record '{t.name}'" for t, now, was in pairs if now != was]
    if changed:
        raise UserError(
            f"{path}: {', '.join(changed)} changed since the run began: put it back, or start a "
            "new run"
        )


def _digests(problem: Problem, test: str | None) -> dict[str, Any]:
    control, base = problem.control, problem.identification
    plant = (control or problem).plant
    return {
        "train": [data_digest([t]) for t in _records(problem)],
        "test": test,
        "description": text_digest(problem.description),
        "notes": text_digest(problem.notes) if problem.notes else None,
        "strategies": text_digest(problem.strategies) if problem.strategies else None,
        "baseline": None if problem.baseline is None else text_digest(problem.baseline),
        "physics": None if base.physics is None else physics_digest(base.physics),
        "plant": plant and plant.digest,
        "control": control and _json_digest(control.toml()),
        "models": control and [hashlib.sha256(m).hexdigest() for m in control.models],
        "frequency": tuple(one.digest for one in base.responses) or None,
        "symmetry": symmetry_digest(problem.symmetry) if problem.symmetry else None,
        "protocol": protocol_digest(problem),
    }


def _records(problem: Problem) -> tuple[Trajectory, ...]:
    """Training records; scenarios, then open-loop records of a control problem."""
    return (*problem.train, *(problem.control.base.train if problem.control else ()))


def _flat(table: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in table.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value
