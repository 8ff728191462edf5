"""Export of a run's model: composition, parity check, usage page."""

import json
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast, get_args

import numpy as np
from numpy.typing import NDArray

from asia._files import write_file
from asia._plugins import Part, parts_of
from asia._progress import tracked
from asia._text import suggestion
from asia.data.preprocess import Preprocess
from asia.data.segment import Segment, SimulatedSegment
from asia.data.trajectory import INTERSAMPLE, Array, Signal
from asia.errors import UserError
from asia.export.model import Band, ExportModel
from asia.export.target import ParityRow, Target, parity_row
from asia.export.targets.c import CTarget
from asia.export.targets.casadi import CasadiTarget
from asia.export.targets.fmu import FmuTarget
from asia.export.targets.matlab import MatlabTarget
from asia.export.targets.numpy import NumpyTarget
from asia.export.targets.onnx import OnnxTarget
from asia.judge.evaluation.evaluator import Evaluator
from asia.judge.sandbox.types import Isolation
from asia.ledger.events import Use
from asia.ledger.run import Run, model_to_use, open_run, scored_experiment
from asia.lowering.program import Builder, LoweredModel, inlined
from asia.models._numerics.intersample import inputs_of
from asia.problem.load import load_lock
from asia.search.run import LOCK, make_evaluator
from asia.search.simulation import (
    FinalMember,
    final_members,
    fold_models,
    loading_stored_models,
    simulate,
    simulate_members,
)

_GROUP = "asia.export_targets"

_ALL: tuple[Target, ...] = (
    NumpyTarget(),
    CTarget(),
    OnnxTarget(),
    FmuTarget(),
    CasadiTarget(),
    MatlabTarget(),
)
TARGETS: dict[str, Target] = {t.name: t for t in _ALL}
"""The built-in targets."""


def target_names() -> tuple[str, ...]:
    """Names that `--to` accepts: the built-in targets, then those of installed packages."""
    return (*TARGETS, *(part.name for part in parts_of(_GROUP) if part.name not in TARGETS))


def find_target(name: str) -> Target:
    """Return the target of that name. Raises UserError when there is none, an installed package
    brings something else by that name, or a program that the target needs is not installed."""
    plugged = {part.name: part for part in parts_of(_GROUP)}
    if name in TARGETS:
        found = TARGETS[name]
    elif name in plugged:
        found = _load(plugged[name])
    else:
        raise UserError(
            f"export target '{name}' is unknown{suggestion(name, target_names())} (installed are "
            f"{', '.join(target_names())})"
        )
    missing = found.missing()
    if missing is not None:
        raise UserError(f"--to {name}: {missing}")
    return found


def _load(part: Part) -> Target:
    make = part.load()
    found = make() if isinstance(make, type) else make
    methods = ("missing", "print", "run")
    if not all(callable(getattr(found, method, None)) for method in methods):
        raise UserError(
            f"{part.target} of package {part.package} {part.version} is {make!r}, expected an "
            "asia.export.target.Target, or its class, with missing(), print() and run()"
        )
    if getattr(found, "name", None) != part.name:
        raise UserError(
            f"export target '{part.name}' of package {part.package} calls itself "
            f"{getattr(found, 'name', None)!r}: give it the name of its entry point"
        )
    return cast("Target", found)


# What happens outside the candidate is composed here, once for all targets: the weighted mean of
# lowered models, and maps of the signals before a model reads them and of outputs after it.


def weighted_mean(parts: Sequence[tuple[float, LoweredModel]]) -> LoweredModel:
    """Combine models of the same signals; the weights add up to 1."""
    first = parts[0][1]
    if len(parts) == 1:
        return first
    initial = Builder(first.initial.inputs)
    window = list(range(len(initial.inputs)))
    starts = [x for _, model in parts for x in inlined(initial, model.initial, window)]
    states = [shape for _, model in parts for shape in model.states]
    step = Builder((*states, (first.nu,)))
    outputs, after = list[int](), list[int]()
    for _, model in parts:
        own = range(len(after), len(after) + len(model.states))
        y, *found = inlined(step, model.step, [*own, len(states)])
        outputs.append(y)
        after += found
    total, *others = [
        step.add("mul", (step.constant(np.float64(weight)), y))
        for (weight, _), y in zip(parts, outputs, strict=True)
    ]
    for one in others:
        total = step.add("add", (total, one))
    single = any(model.single for _, model in parts)
    return LoweredModel(
        first.n_past_u,
        first.n_past_y,
        first.nu,
        first.ny,
        single,
        initial.program(starts),
        step.program([total, *after]),
    )


# Page USE.md, which is written next to every target.


def usage_page(target: Target, model: ExportModel, rows: Sequence[ParityRow]) -> str:
    """Describe the model, the use of the files and the comparison with ASIA."""
    low = model.lowered
    inputs, outputs = (
        ", ".join(signal.label for signal in side) for side in (model.inputs, model.outputs)
    )
    compared: list[str] = []
    for row in rows:
        gap = "" if row.difference is None else f"{row.difference:.1e}"
        gap = ", ".join(part for part in (gap, row.note) if part)
        time = "" if row.microseconds is None else f"{row.microseconds:.2f}"
        compared.append(f"| {row.target} | {gap} | {time} | {row.bytes} |")
    lines = [
        f"# {model.problem}: {model.use} of run {model.name}",
        "",
        f"Inputs {inputs}; outputs {outputs}; sampling time "
        f"{model.sampling_time:g} s. {_between(model)} The model starts from a "
        f"past window of {low.n_past_u} inputs and {low.n_past_y} outputs, the oldest first, and "
        "the input of the first sample. Output k belongs to input k.",
        "",
        target.usage,
        "",
        "| compared on the training windows | largest difference | microseconds a sample | bytes |",
        "|---|---|---|---|",
        *compared,
        "",
        "The difference is relative to the spread of the measured output.",
    ]
    for signal, (low_end, high) in zip(model.inputs, model.input_range.tolist(), strict=True):
        lines.append(f"Trained with {signal.name} from {low_end:g} to {high:g} {signal.unit}.")
    for band in model.bands:
        width = ", ".join(f"{w:.3g}" for w in band.half_width.tolist())
        lines.append(
            f"About {band.level:.0%} of measured outputs lie within {width} of the simulation, "
            "inside the region of the training records."
        )
    return "\n".join([*lines, *model.notes, ""])


def _between(model: ExportModel) -> str:
    """Sentence on the inputs between samples."""
    kinds = dict(zip((s.name for s in model.inputs), model.between, strict=False))
    moving = [f"{name} is {INTERSAMPLE[kind]}" for name, kind in kinds.items() if kind != "zero"]
    if not moving:
        return "Inputs are held between samples."
    rest = "; the others are held" if len(moving) < len(kinds) else ""
    return f"Between samples {', '.join(moving)}{rest}."


def table(rows: Sequence[ParityRow]) -> list[str]:
    """Comparison as lines for a terminal."""
    found = [f"{'target':16}{'difference':>12}{'us/sample':>12}{'bytes':>10}"]
    for row in rows:
        gap = "not run" if row.difference is None else f"{row.difference:.1e}"
        time = "" if row.microseconds is None else f"{row.microseconds:.2f}"
        note = f"  {row.note}" if row.note else ""
        found.append(f"{row.target:16}{gap:>12}{time:>12}{row.bytes:>10}{note}")
    return found


# Delays and decimation of `[preprocess]` composed into a model, so that exported files read and
# return measured signals. What a fit does to its own records is part of its model.
#
# The files step at the rate of the samples that were kept. Their state holds the inputs that a
# delay still keeps back.


def kept_delays(done: Preprocess, inputs: Sequence[Signal]) -> list[int]:
    """Delay of each input, in samples that are kept. Raises UserError if one is no whole number."""
    every, kept = done.decimate, list[int]()
    for signal in inputs:
        delay = done.delay.get(signal.name, 0)
        if delay % every:
            raise UserError(
                f"preprocess.delay of '{signal.name}' is {delay} samples, no multiple of decimate "
                f"{every}: exported files step at the rate of the samples that are kept; simulate "
                "with asia.simulate, or make a run with a multiple"
            )
        kept.append(delay // every)
    return kept


def measured(low: LoweredModel, done: Preprocess, inputs: Sequence[Signal]) -> LoweredModel:
    """Convert a model of delayed inputs to one of measured inputs. Raises UserError as for
    `kept_delays`."""
    late = np.array(kept_delays(done, inputs))
    longest, n, nu = int(late.max()), low.n_past_u, low.nu
    if not longest:
        return low
    channels = np.arange(nu)

    def latest(build: Builder, known: int, first: int) -> list[int]:
        """Inputs that delays keep back: the rows of `known` from `first` on."""
        rows = np.arange(first, first + longest)[:, None] * nu + channels
        return [_picked(build, known, rows)]

    # The states begin from the measured past window.
    build = Builder(((n + longest, nu), (low.n_past_y, low.ny), (nu,)))
    known = _stacked(build, 0, 2)
    rows = np.arange(n)[:, None] + longest - late
    past_u = _picked(build, known, rows * nu + channels)
    u = _picked(build, known, (n + longest - late) * nu + channels)
    held_back = latest(build, known, n)
    initial = build.program([*held_back, *inlined(build, low.initial, [past_u, 1, u])])

    # A step reads the inputs that act now, and keeps the newest back.
    step = Builder(((longest, nu), *low.states, (nu,)))
    known = _stacked(step, 0, len(step.inputs) - 1)
    acting = _picked(step, known, (longest - late) * nu + channels)
    y, *after = inlined(step, low.step, [*range(1, 1 + len(low.states)), acting])
    held_back = latest(step, known, 1)
    return LoweredModel(
        n + longest,
        low.n_past_y,
        nu,
        low.ny,
        low.single,
        initial,
        step.program([y, *held_back, *after]),
    )


def measured_window(
    window: SimulatedSegment, done: Preprocess, inputs: Sequence[Signal]
) -> SimulatedSegment:
    """Window with inputs as measured, at the samples that are kept.

    It is shorter by the longest delay; inputs before it that no model reads are made up.
    """
    late = kept_delays(done, inputs)
    longest, n = max(late), len(window.past_u)
    acting = np.concatenate([window.past_u, window.u])
    rows = np.arange(len(acting))[:, None] - longest + np.array(late)
    u = acting[np.clip(rows, 0, len(acting) - 1), np.arange(acting.shape[1])]
    shorter = window.part(0, len(window.u) - longest)
    return replace(shorter, past_u=u[: n + longest], u=u[n + longest :])


def _stacked(build: Builder, rows: int, last: int) -> int:
    """Append a row: rows (R, n) and (n,) -> (R + 1, n)."""
    (n,) = build.shape(last)
    return build.add("concat", (rows, build.add("reshape", (last,), (1, n))), (0,))


def _picked(build: Builder, value: int, places: NDArray[np.int64]) -> int:
    attrs = (places.ndim, *places.shape, *places.reshape(-1))
    return build.add("pick", (value,), tuple(int(a) for a in attrs))


# Export of a model of a run: lower it, print it for each target, compare the files.


_MOST_SAMPLES, _MOST_WINDOWS = 6000, 64
_LEVEL, _EXAMPLE = 0.9, 100


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
    sampling_time: float
    """Time in s from one step of the files to the next."""
    notes: tuple[str, ...]


@dataclass(frozen=True)
class Ready:
    """Lowered model of a run, with the windows that every target is compared on."""

    model: ExportModel
    """Model as the printers receive it."""
    windows: tuple[SimulatedSegment, ...]
    """Windows from the training records."""


def export(
    directory: Path | str,
    targets: Sequence[str],
    model: str | None = None,
    out: Path | None = None,
    *,
    isolation: Isolation | None = None,
) -> list[Exported]:
    """Print a model of a finished run for each target and compare it with ASIA's own simulation.

    Args:
        directory: folder of the run.
        targets: names of the targets.
        model: `ensemble`, `refit`, `stack`, or the number of an experiment, whose fold models are
            averaged; None for the model that the search recommends.
        out: folder that receives a folder for each target; None for `export` in the run.
        isolation: level of the candidate; None for the strongest of this machine.

    Raises:
        UserError: for an unknown target, a model that cannot be exported, and files that differ
            from ASIA's simulation, which are not written.
    """
    chosen = [find_target(name) for name in dict.fromkeys(targets)]
    run = open_run(Path(directory))
    ready = lowered_run(run, model, isolation)
    folder = run.directory / "export" if out is None else out
    return [write(one, ready, folder / one.name) for one in chosen]


def write(one: Target, ready: Ready, folder: Path) -> Exported:
    """Print for one target, compare, then write. Raises UserError if the difference exceeds the
    limit."""
    printed = one.print(ready.model)
    with tempfile.TemporaryDirectory(prefix="asia-export-") as made:
        _put(Path(made), printed.files)
        answers = one.run(Path(made), ready.windows)
    if not answers:
        raise UserError(f"--to {one.name}: the files gave no simulation to compare")
    # Each row has the files that disable its variant.
    rows: list[tuple[ParityRow, Mapping[str, bytes]]] = []
    if isinstance(answers, str):
        rows.append((ParityRow(one.name, None, 0.0, None, printed.bytes, answers), {}))
    else:
        single = ready.model.lowered.single
        for a in answers:
            row = parity_row(one.name, a, ready.windows, single, printed.bytes)
            rows.append((row, a.without))
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
    note = "differs too much: the files refuse it"
    parity = [row if row.holds else replace(row, note=note) for row, _ in rows]
    files["USE.md"] = usage_page(one, ready.model, parity).encode()
    facts = ready.model.facts()
    if printed.sizes:
        facts["sizes"] = printed.sizes
    files["model.json"] = (json.dumps(facts, indent=2, allow_nan=False) + "\n").encode()
    _put(folder, files)
    return Exported(
        one.name, folder, tuple(folder / name for name in files), tuple(parity),
        ready.model.sampling_time, ready.model.notes,
    )  # fmt: skip


def lowered_run(run: Run, model: str | None, isolation: Isolation | None = None) -> Ready:
    """Lower the model of a run. isolation: as in `export`. Raises UserError if it cannot be
    lowered."""
    use, members = _members(run, model)
    problem = load_lock(run.directory / LOCK)
    done, inputs = problem.preprocess, problem.inputs
    kept_delays(done, inputs)
    evaluator = make_evaluator(problem, run.view, isolation=isolation)
    parts: list[tuple[float, LoweredModel]] = []
    heaviest = run.store.text(max(members, key=lambda one: one.weight).source)
    for member in tracked(members, "model"):
        models = [run.store.get(one) for one in member.models]
        with loading_stored_models(run.view):
            found = evaluator.models.lowered(run.store.text(member.source), models)
        for one in found:
            if isinstance(one, str):
                raise UserError(f"run '{run.name}': the model cannot be exported: {one}")
            parts.append((member.weight / len(models), one))
    lowered = measured(weighted_mean(parts), done, inputs)
    each = _windows(evaluator, run, members)
    windows = [measured_window(window, done, inputs) for window in each]
    named = next((known for known in get_args(Use) if known == use), None)
    u, y = (
        np.concatenate([getattr(r, side) for r in evaluator.data.records]) for side in ("u", "y")
    )
    notes: tuple[str, ...] = ()
    if done.decimate > 1:
        notes = (
            f"The model steps every {problem.sampling_time:g} s: of the records one sample in "
            f"{done.decimate} was kept. An input is the mean over {done.decimate} samples, from "
            "the kept one on; an output belongs to the kept one.",
        )
    return Ready(
        ExportModel(
            name=run.name,
            use=use,
            problem=problem.name,
            lowered=lowered,
            inputs=inputs,
            outputs=problem.outputs,
            sampling_time=problem.sampling_time,
            input_range=_range(u),
            output_range=_range(y),
            example=windows[0].part(0, _EXAMPLE),
            bands=() if named is None else _bands(run, named, windows[0], done.decimate, isolation),
            notes=notes,
            between=inputs_of(heaviest, inputs, evaluator.data.records),
        ),
        tuple(windows),
    )


def _members(run: Run, model: str | None) -> tuple[str, tuple[FinalMember, ...]]:
    """Name of the model and its members."""
    known: tuple[Use, ...] = get_args(Use)
    if model is not None and model.isdigit():
        number = int(model)
        return f"experiment {number}", (fold_models(scored_experiment(run, number)),)
    if model is None:
        chosen = model_to_use(run.view)
        if chosen is None:
            raise UserError(f"run '{run.name}' has no scored model")
        model = chosen.model
    for use in known:
        if use == model:
            return use, final_members(run.view, use)
    raise UserError(
        f"--model is '{model}', expected {', '.join(known)} or the number of an experiment"
    )


def _windows(
    evaluator: Evaluator, run: Run, members: Sequence[FinalMember]
) -> list[SimulatedSegment]:
    """First training windows, the last of them cut short."""
    blocks: list[Segment] = []
    left = _MOST_SAMPLES
    for block in evaluator.data.training_blocks[:_MOST_WINDOWS]:
        samples = min(len(block.y), left)
        if samples < 1:
            break
        left -= samples
        blocks.append(replace(block, u=block.u[:samples], y=block.y[:samples]))
    each = simulate_members(evaluator, run, members, blocks)
    return [block.simulated(y_hat.mean(axis=0)) for block, y_hat in zip(blocks, each, strict=True)]


def _bands(
    run: Run, use: Use, first: SimulatedSegment, every: int, isolation: Isolation | None
) -> tuple[Band, ...]:
    """Mean half width of the output bands on a window, inside the region of validity."""
    past_u, past_y, u = (
        np.repeat(side, every, axis=0) for side in (first.past_u, first.past_y, first.u)
    )
    found = simulate(run.directory, past_u, past_y, u, use, bands=_LEVEL, isolation=isolation)
    if any(found.withdrawn):
        return ()
    inside = ~found.outside if not found.outside.all() else np.ones_like(found.outside)
    return (Band(_LEVEL, 0.5 * (found.upper - found.lower)[inside].mean(axis=0)),)


def _range(values: Array) -> Array:
    return np.stack([values.min(axis=0), values.max(axis=0)], axis=1)


def _put(folder: Path, files: dict[str, bytes]) -> None:
    """Write files; a link in place of the folder or of anything below it is not followed."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    for name, data in files.items():
        write_file(folder.parent.resolve(), f"{folder.name}/{name}", data)
