"""A search that goes on from a finished one with one more record: the problem is copied, and the
leading candidates are the first proposals."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

from asia._files import read_file
from asia.errors import CandidateError, UserError
from asia.judge.sandbox.types import Isolation
from asia.judge.scoring.outcome import Failure, Outcome
from asia.ledger.run import Run, model_to_use
from asia.ledger.view import Experiment, SearchView
from asia.problem.create import record_csv, save_problem
from asia.problem.folds import whole
from asia.problem.load import load_lock, read_records
from asia.problem.problem import Problem
from asia.problem.toml import toml_text
from asia.search.guard import error_on, simulated
from asia.search.run import LOCK, make_evaluator
from asia.search.simulation import final_members, fold_models, loading_stored_models

_TEXTS = {"description": "description.md", "notes": "notes.md", "strategies": "strategies.md"}


def leading_experiments(view: SearchView, count: int, far: float) -> list[Experiment]:
    """The best experiment, the best of other families, then further ones, by V.

    Args:
        count: at most so many
        far: largest V, in that of the best

    Raises:
        UserError: if no candidate has a score
    """
    best = view.best
    if best is None or best.score is None:
        raise UserError(f"run '{view.started.run}' has no scored model")
    others = [
        (e.score.value, e) for e in view.finished
        if e.score is not None and e.number != best.number and not e.unconfirmed
        and e.score.value <= far * best.score.value
        and e.result is not None and e.result.duplicate_of is None
    ]  # fmt: skip
    first, again, families = [best], list[Experiment](), {best.proposed.family}
    for _, one in sorted(others, key=lambda pair: pair[0]):
        (again if one.proposed.family in families else first).append(one)
        families.add(one.proposed.family)
    return [*first, *again][:count]


def error_on_record(
    run: Run, path: Path, isolation: Isolation | None = None
) -> tuple[str, Outcome]:
    """Name of the model to use, and its error on a new record as V has it: in the search's metric,
    over the standard deviations of the old training records. Where a stack is the model to use, the
    ensemble is asked."""
    problem, view = load_lock(run.directory / LOCK), run.view
    named, best = model_to_use(view), view.best
    if named is None or best is None:
        raise UserError(f"run '{run.name}' has no scored model")
    use = "refit" if named.model == "refit" else "ensemble"
    names = final_members(view, "refit")[0].models if use == "refit" else fold_models(best).models
    blocks = whole(read_records(problem, path), problem.protocol)
    source, models = run.store.text(best.source), [run.store.get(n) for n in names]
    with loading_stored_models(view):
        evaluator = make_evaluator(problem, view, isolation=isolation)
        try:
            y_hat = simulated(evaluator, source, models, blocks)
            return use, error_on(evaluator, y_hat, blocks)
        except CandidateError as error:
            return use, Failure(error.reason, error.detail)


def extended_problem(run: Run, record: Path, directory: Path) -> tuple[Problem, tuple[str, ...]]:
    """Write a copy of the problem of a run with one more training record, and load it; a copy that
    is there already is verified.

    Records in files stay where they are; those of another source become CSV files in the copy,
    without the test and the guard of that source. Raises UserError.

    Returns:
        the problem, and notes on what the copy lacks
    """
    problem = load_lock(run.directory / LOCK)
    tables: dict[str, Any] = tomllib.loads((run.directory / LOCK).read_text("utf-8"))
    del tables["digests"]
    files: dict[str, str] = {}
    notes: list[str] = []
    for name, file in _TEXTS.items():
        text = tables.pop(name, None)
        if text:
            files[file], tables[name] = text, file
    baseline = tables.pop("baseline", None)
    if baseline is not None:
        files["baseline.py"] = baseline
    data: dict[str, Any] = tables["data"]
    names = [*(s.name for s in problem.inputs), *(s.name for s in problem.outputs)]
    if "source" in data:
        if problem.loop is not None and problem.loop.reference:
            raise UserError("the records of this source have a reference, which no copy keeps")
        old = problem.data.records("train", problem.channels).trajectories
        files |= {f"{one.name}.csv": record_csv(one, names) for one in old}
        if problem.test.source is not None:
            notes.append("the copy has no test: that of the old source stays with the old run")
        data = {"groups": data.get("groups"), "period": data.get("period"),
                "frequency": data.get("frequency"),
                "train": [f"{one.name}.csv" for one in old]}  # fmt: skip
    name = record.name
    if name in files or any(Path(one).name == name for one in data["train"]):
        raise UserError(f"a training record is called {name} already: rename the new file")
    files[name] = read_file(record, "name a file with the new record").decode("utf-8")
    data["train"] = [*data["train"], name]
    groups: dict[str, list[str]] = data.get("groups") or {}
    if groups:
        data["groups"] = {**groups, record.stem: [record.stem]}
    tables["data"], tables["name"] = data, directory.name
    files["problem.toml"] = toml_text(tables)
    return save_problem(directory, files), tuple(notes)
