"""Declaration of the run whose sealed test may be opened, written before its search begins."""

from __future__ import annotations

import json
from pathlib import Path

from asia.bench._plan import ComparisonPlan
from asia.errors import UserError
from asia.ledger import write_whole

_FILE = "bench.json"


def declare(plan: ComparisonPlan) -> str | None:
    """Return the name of the declared run, written to `bench.json` on the first call.

    The declaration is final.

    Returns:
        The name; None if the plan has no expert, or if the run had begun before a declaration.

    Raises:
        UserError: the file cannot be read or belongs to another problem.
    """
    path = plan.directory / _FILE
    if path.is_file():
        return _read(path, plan.problem.name)
    name = plan.candidate_for_test
    if name is None or (plan.runs / name / "ledger.jsonl").exists():
        return None
    text = json.dumps({"problem": plan.problem.name, "declared": name}, indent=2)
    write_whole(path, f"{text}\n".encode())
    return name


def require_declared(plan: ComparisonPlan, declared: str | None) -> str:
    """The run to unseal after the searches of `plan`. Raises UserError when there is none."""
    if plan.quick:
        raise UserError(
            "--unseal with --quick: the sealed test is opened once, for a full comparison; leave "
            "one of them out"
        )
    if declared is None:
        raise UserError(
            "--unseal: no run was declared before its search began (the expert's with the first "
            "seed is); start the comparison with the expert in another --runs"
        )
    if declared not in {search.name for search in plan.searches}:
        raise UserError(
            f"--unseal: run '{declared}' was declared for the sealed test, and this comparison "
            "does not contain it: add its seed, arm and early-stopping setting"
        )
    return declared


def _read(path: Path, problem: str) -> str | None:
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise UserError(f"cannot read {path}: {error}") from error
    declared = found.get("declared") if isinstance(found, dict) else None
    if not isinstance(declared, str) or found.get("problem") != problem:
        raise UserError(f"{path} does not declare a run of problem '{problem}': put it back")
    return declared
