"""Export of a model of a run: lower it, print it for each target, compare the files."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import get_args

import numpy as np

from asia.data import Array
from asia.data._preprocess import Preprocess
from asia.errors import UserError
from asia.evaluation import Evaluator
from asia.export._composed import weighted_mean
from asia.export._model import Band, ExportModel, Printed, TrainingWindow
from asia.export._parity import ParityRow, parity_row
from asia.export._preprocessed import kept_delays, measured, measured_window, physical
from asia.export._registry import find_target
from asia.export._target import Target
from asia.export._usage import usage_page
from asia.ledger import Run, Use, model_to_use, open_run
from asia.lowering import LoweredModel
from asia.problem.load import load_lock
from asia.protocol import Block, Case
from asia.search import (
    LOCK,
    FinalMember,
    final_members,
    fold_models,
    make_evaluator,
    simulate,
    simulate_members,
)

_MOST_SAMPLES, _MOST_WINDOWS = 6000, 64
_LEVEL, _EXAMPLE = 0.9, 100
_REFUSED = "differs too much: the files refuse it"


@dataclass(frozen=True)
class Exported:
    """Files that were written for one target."""

    target: str
    """Target as in `--to`."""
    folder: Path
    """Folder of the files."""
    files: tuple[Path, ...]
    """Paths of all files."""
    parity: tuple[ParityRow, ...]
    """Comparison with ASIA's own simulation, one row a variant."""


@dataclass(frozen=True)
class Ready:
    """Lowered model of a run, with the windows that every target is compared on."""

    model: ExportModel
    """Model as the printers receive it."""
    windows: tuple[TrainingWindow, ...]
    """Windows from the training records."""


def export(
    directory: Path | str, targets: Sequence[str], model: str | None = None, out: Path | None = None
) -> list[Exported]:
    """Print a model of a finished run for each target and compare it with ASIA's own simulation.

    Args:
        directory: folder of the run.
        targets: names of the targets.
        model: `ensemble`, `refit`, `stack`, or the number of an experiment, whose fold models are
            averaged; None for the model that the search recommends.
        out: folder that receives a folder for each target; None for `export` in the run.

    Raises:
        UserError: for an unknown target, a model that cannot be exported, and files that differ
            from ASIA's simulation, which are not written.
    """
    chosen = [find_target(name) for name in dict.fromkeys(targets)]
    run = open_run(Path(directory))
    ready = lowered_run(run, model)
    folder = run.directory / "export" if out is None else out
    return [write(one, ready, folder / one.name) for one in chosen]


def write(one: Target, ready: Ready, folder: Path) -> Exported:
    """Print for one target, compare, then write.

    Raises:
        UserError: if the difference exceeds the limit.
    """
    printed = one.print(ready.model)
    with tempfile.TemporaryDirectory(prefix="asia-export-") as made:
        trial = Path(made)
        _put(trial, printed.files)
        rows = _compared(one, trial, printed, ready)
    wrong = next((r for r, without in rows if not r.holds and not without), None)
    if wrong is not None:
        raise UserError(
            f"--to {one.name}: nothing was written: {wrong.target} differs from ASIA's own "
            f"simulation by {wrong.difference:.1e} of the outputs' spread, at most "
            f"{wrong.limit:.0e} is allowed; try another model (--model) or target"
        )
    files = dict(printed.files)
    for row, without in rows:
        files.update({} if row.holds else without)
    rows = [row if row.holds else replace(row, note=_REFUSED) for row, _ in rows]
    files["USE.md"] = usage_page(one, ready.model, rows).encode()
    facts = ready.model.facts()
    if printed.sizes:
        facts["sizes"] = printed.sizes
    text = json.dumps(facts, indent=2, allow_nan=False) + "\n"
    files["model.json"] = text.encode()
    _put(folder, files)
    paths = tuple(folder / name for name in files)
    return Exported(one.name, folder, paths, tuple(rows))


def _compared(
    one: Target, folder: Path, printed: Printed, ready: Ready
) -> list[tuple[ParityRow, Mapping[str, bytes]]]:
    """Parity rows, each with the files that disable its variant."""
    found = one.run(folder, ready.windows)
    if isinstance(found, str):
        return [(ParityRow(one.name, None, 0.0, None, printed.bytes, found), {})]
    if not found:
        raise UserError(f"--to {one.name}: the files gave no simulation to compare")
    single = ready.model.lowered.single
    return [
        (parity_row(one.name, a, ready.windows, single, printed.bytes), a.without) for a in found
    ]


def lowered_run(run: Run, model: str | None) -> Ready:
    """Lower the model of a run.

    Raises:
        UserError: if it cannot be lowered.
    """
    use, members = _members(run, model)
    problem = load_lock(run.directory / LOCK)
    done, inputs, outputs = problem.preprocess, problem.channels.inputs, problem.channels.outputs
    kept_delays(done, inputs)
    evaluator = make_evaluator(problem, run.view)
    lowered = measured(weighted_mean(_lowered(evaluator, run, members)), done, inputs, outputs)
    each = _windows(evaluator, run, members)
    windows = [measured_window(window, done, inputs, outputs) for window in each]
    named = next((known for known in get_args(Use) if known == use), None)
    u, y = (np.concatenate([getattr(r, side) for r in evaluator.records]) for side in ("u", "y"))
    return Ready(
        ExportModel(
            name=run.name,
            use=use,
            problem=problem.name,
            lowered=lowered,
            inputs=inputs,
            outputs=outputs,
            sampling_time=problem.sampling_time,
            input_range=_range(physical(u, done, inputs)),
            output_range=_range(physical(y, done, outputs)),
            example=windows[0].first(_EXAMPLE),
            bands=() if named is None else _bands(run, named, windows[0], done.decimate),
            notes=_notes(done, problem.sampling_time),
        ),
        tuple(windows),
    )


def _members(run: Run, model: str | None) -> tuple[str, tuple[FinalMember, ...]]:
    known: tuple[str, ...] = get_args(Use)
    if model is not None and model.isdigit():
        number = int(model)
        scored = {e.number: e for e in run.view.experiments if e.result is not None}
        if number not in scored:
            raise UserError(f"run '{run.name}' has no scored experiment {number}")
        return f"experiment {number}", (fold_models(scored[number]),)
    chosen = model_to_use(run.view)
    if model is None:
        if chosen is None:
            raise UserError(f"run '{run.name}' has no scored model")
        model = chosen.model
    for use in get_args(Use):
        if use == model:
            return use, final_members(run.view, use)
    raise UserError(
        f"--model is '{model}', expected {', '.join(known)} or the number of an experiment"
    )


def _lowered(
    evaluator: Evaluator, run: Run, members: Sequence[FinalMember]
) -> list[tuple[float, LoweredModel]]:
    found: list[tuple[float, LoweredModel]] = []
    for member in members:
        models = [run.store.get(one) for one in member.models]
        for one in evaluator.lowered(run.store.text(member.source), models):
            if isinstance(one, str):
                raise UserError(f"run '{run.name}': the model cannot be exported: {one}")
            found.append((member.weight / len(models), one))
    return found


def _windows(
    evaluator: Evaluator, run: Run, members: Sequence[FinalMember]
) -> list[TrainingWindow]:
    """First training windows, the last of them cut short."""
    blocks: list[Block] = []
    left = _MOST_SAMPLES
    for block in evaluator.training_blocks[:_MOST_WINDOWS]:
        case, samples = block.case, min(len(block.y), left)
        if samples < 1:
            break
        left -= samples
        short = Case(case.name, case.past_u, case.past_y, case.u[:samples])
        blocks.append(Block(short, block.y[:samples], record=block.record, start=block.start))
    each = simulate_members(evaluator, run, members, blocks)
    return [
        TrainingWindow(b.case.past_u, b.case.past_y, b.case.u, y.mean(axis=0), b.y)
        for b, y in zip(blocks, each, strict=True)
    ]


def _notes(done: Preprocess, sampling_time: float) -> tuple[str, ...]:
    if done.decimate == 1:
        return ()
    return (
        f"The model steps every {sampling_time:g} s: of the records one sample in {done.decimate} "
        f"was kept. An input is the mean over {done.decimate} samples, from the kept one on; an "
        "output belongs to the kept one.",
    )


def _bands(run: Run, use: Use, first: TrainingWindow, every: int) -> tuple[Band, ...]:
    """Mean half width of the output bands on a window, inside the region of validity."""
    past_u, past_y, u = (
        np.repeat(side, every, axis=0) for side in (first.past_u, first.past_y, first.u)
    )
    found = simulate(run.directory, past_u, past_y, u, use, bands=_LEVEL)
    inside = ~found.outside if not found.outside.all() else np.ones_like(found.outside)
    return (Band(_LEVEL, 0.5 * (found.upper - found.lower)[inside].mean(axis=0)),)


def _range(values: Array) -> Array:
    return np.stack([values.min(axis=0), values.max(axis=0)], axis=1)


def _put(folder: Path, files: dict[str, bytes]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name, data in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
