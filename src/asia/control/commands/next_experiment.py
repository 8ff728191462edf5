"""asia next: the input of the next experiment."""

from __future__ import annotations

import json as jsonlib
import re
from collections.abc import Sequence
from dataclasses import asdict
from functools import partial
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from asia._text import say
from asia.errors import UserError
from asia.interfaces.cli.options import RunName, RunOptions

if TYPE_CHECKING:
    from asia.control.experiment_design import Judged, RunExperiment


def next_(
    *,
    run: RunName = None,
    duration: Annotated[float, typer.Option(help="Length of the record in s.")] = 0.0,
    limits: Annotated[
        list[str] | None,
        typer.Option(
            help="Limits of an input, u=0..10, repeatable; default: those of the training records."
        ),
    ] = None,
    rate: Annotated[
        list[str] | None,
        typer.Option(help="Largest change of an input in a second, u=0.5, repeatable."),
    ] = None,
    keep: Annotated[
        list[str] | None, typer.Option(help='Limit of an output, "y<9" or "y>1", repeatable.')
    ] = None,
    start: Annotated[
        list[str] | None,
        typer.Option(
            help="Input before the record, u=2, repeatable; default: its mean in the records."
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(help="Folder for next.csv and the picture; default: next in the run."),
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of the search.")] = 0,
    options: RunOptions,
) -> None:
    """Propose the input of the next experiment: the one that tells most about where the leading
    models differ, within limits of inputs and of the expected outputs."""
    if not duration > 0:
        raise UserError("--duration is missing: give the length of the record in s")
    from asia.control.drawing import draw_experiment
    from asia.control.experiment_design import next_experiment
    from asia.problem.load import load_lock
    from asia.report.files import save
    from asia.search.run import LOCK

    directory = options.directory(run)
    problem = load_lock(directory / LOCK)
    inputs = [s.name for s in problem.inputs if s.is_actuated]
    others = [s.name for s in problem.inputs if not s.is_actuated]
    outputs = [s.name for s in problem.outputs]
    planned = partial(_named, names=inputs, short="u", disturbances=others)
    spans = {name: _span(text, value) for name, value, text in planned("--limits", limits)}
    rates = {name: _number(text, value) for name, value, text in planned("--rate", rate)}
    held = {
        name: _number(text, value)
        for name, value, text in _named("--start", start, [*inputs, *others], "u")
    }
    if any(not value > 0 for value in rates.values()):
        raise UserError("--rate: expected positive numbers")
    if held and not set(inputs) <= set(held):
        raise UserError(f"--start: expected all inputs ({', '.join(inputs)})")
    kept = _kept(keep or (), outputs)
    made = next_experiment(
        directory, duration, spans, rates, kept, start=held, seed=seed,
        isolation=options.level,
    )  # fmt: skip
    folder = directory / "next" if out is None else out
    folder.mkdir(parents=True, exist_ok=True)
    found = made.found
    every = problem.preprocess.decimate
    u = np.repeat(found.proposed.u, every, axis=0)
    t = made.sampling_time / every * np.arange(len(u))
    header = ",".join(f'"{n}"' if "," in n else n for n in ("time", *(s.name for s in made.inputs)))
    np.savetxt(
        folder / "next.csv", np.column_stack([t, u]), fmt="%.9g", delimiter=",", header=header,
        comments="",
    )  # fmt: skip
    named = (("proposed", found.proposed), ("APRBS", found.aprbs), ("multisine", found.multisine))
    bounds = np.array([kept.get(name, (-np.inf, np.inf)) for name in outputs]).T

    def draw() -> Any:
        columns = [(name, one.u, one.y, one.lower, one.upper) for name, one in named]
        ends = found.limits.low, found.limits.high
        return draw_experiment(
            columns, (made.inputs, made.outputs), made.sampling_time, ends, bounds
        )

    facts = _facts(made, named, kept)
    (folder / "next.json").write_text(jsonlib.dumps(facts, allow_nan=False) + "\n", "utf-8")
    files = [folder / "next.csv", *save([("next", draw)], folder), folder / "next.json"]
    if options.json:
        say(jsonlib.dumps(facts, allow_nan=False))
    options.print(() if options.json else facts["text"], files)
    if found.proposed.excess and not options.json:
        raise typer.Exit(1)


def _named(
    option: str,
    texts: Sequence[str] | None,
    names: Sequence[str],
    short: str,
    disturbances: Sequence[str] = (),
) -> list[tuple[str, str, str]]:
    """Name of the signal, value and the whole text of each NAME=VALUE, several separated by commas;
    a single signal may have the short name or none."""
    found: list[tuple[str, str, str]] = []
    whole = [[t] if t.rpartition("=")[0] in names else t.split(",") for t in texts or ()]
    for text in chain.from_iterable(whole):
        side, _, value = text.rpartition("=")
        if len(names) == 1 and side in ("", short):
            side = names[0]
        if side in disturbances:
            raise UserError(f"{option} is '{text}': {side} is a disturbance, which nobody sets")
        if side not in names:
            raise UserError(
                f"{option} is '{text}', expected NAME=VALUE with one of {', '.join(names)}"
            )
        found.append((side, value, f"{option} {text}"))
    return found


def _number(text: str, value: str) -> float:
    try:
        return float(value)
    except ValueError:
        raise UserError(f"{text}: '{value}' is no number") from None


def _span(text: str, value: str) -> tuple[float, float]:
    low, dots, high = value.partition("..")
    span = _number(text, low), _number(text, high if dots else "")
    if not span[0] < span[1]:
        raise UserError(f"{text}: expected LOW..HIGH, such as 0..10")
    return span


def _kept(texts: Sequence[str], outputs: Sequence[str]) -> dict[str, tuple[float, float]]:
    found: dict[str, tuple[float, float]] = {}
    for text in texts:
        parts = re.fullmatch(r"\s*(.+?)\s*([<>])=?\s*(\S+)\s*", text)
        if parts is None:
            raise UserError(f"--keep is '{text}', expected a limit such as \"y<9\"")
        name = parts[1]
        if len(outputs) == 1 and name == "y":
            name = outputs[0]
        if name not in outputs:
            raise UserError(f"--keep is '{text}', expected one of {', '.join(outputs)}")
        value = _number(f"--keep {text}", parts[3])
        low, high = found.get(name, (-np.inf, np.inf))
        found[name] = (low, value) if parts[2] == "<" else (value, high)
        if not found[name][0] < found[name][1]:
            raise UserError(f"--keep: the limits of '{name}' leave nothing between them")
    return found


def _facts(
    made: RunExperiment, named: Sequence[tuple[str, Judged]], kept: dict[str, tuple[float, float]]
) -> dict[str, Any]:
    """Content of next.json; `text` holds the printed lines."""
    found, numbers = made.found, made.found.members
    proposed = found.proposed
    best = numbers[0]
    of = {n: [k for k, one in enumerate(numbers) if one == n] for n in dict.fromkeys(numbers)}
    others = ", ".join(f"#{n:02d}" for n in list(of)[1:]) or "none"
    duration = made.sampling_time * len(proposed.u)

    def signals(side: Any, values: Any) -> str:
        pairs = zip(side, values, strict=True)
        return ", ".join(f"{s.name} {v:.5g} {s.unit}".rstrip() for s, v in pairs)

    def differences(one: Judged) -> list[float]:
        """Root mean square differences in units of the noise: of the fold models of the best
        experiment, and of each other experiment to it."""
        means = {n: one.y[k].mean(axis=0) for n, k in of.items()}
        folds = one.y[of[best]] - means[best]
        sizes = [folds, *(means[n] - means[best] for n in list(of)[1:])]
        return [float(np.sqrt(np.mean((size / made.noise) ** 2))) for size in sizes]

    lines = [
        f"run {made.run}, fold models of #{best:02d} and of other candidates: {others}",
        f"record    {duration:g} s, {len(proposed.u)} samples",
        f"start     at rest: {signals(made.inputs, made.rest[0])}; "
        f"{signals(made.outputs, made.rest[1])}",
    ]
    for signal, value in made.disturbances:
        lines.append(f"held      {signals([signal], [value])}: a disturbance, which nobody sets")
    for i, signal in enumerate(made.outputs):
        low, high = float(proposed.lower[:, i].min()), float(proposed.upper[:, i].max())
        text = f"{signal.name} between {low:.4g} and {high:.4g} {signal.unit}".rstrip()
        if signal.name in kept:
            ends = kept[signal.name]
            inside = ends[0] <= low and high <= ends[1]
            text += ", inside its limits" if inside else ", NOT inside its limits"
        lines.append(f"expected  {text}")
    rows = {name: differences(one) for name, one in named}
    lines.append(
        "differ    in units of the noise, root mean square"
        f" ({signals(made.outputs, made.noise)} is 1):"
    )
    titles = [f"fold models of #{best:02d}", *(f"#{n:02d} and #{best:02d}" for n in list(of)[1:])]
    lines.append(f"{'':10}{'':<24}" + "".join(f"{name:>12}" for name, _ in named))
    for k, title in enumerate(titles):
        lines.append(f"{'':10}{title:<24}" + "".join(f"{rows[n][k]:>12.3g}" for n, _ in named))
    broken = ["yes" if one.excess else "no" for _, one in named]
    if kept:
        lines.append(f"{'':10}{'may break a limit':<24}" + "".join(f"{v:>12}" for v in broken))
    lines.append(
        "learns    expected error of the model on inputs within the limits, in units of the noise, "
        f"now {found.before:.3g}:"
    )
    after = "".join(f"{one.left:>12.3g}" for _, one in named)
    lines.append(f"{'':10}{'after the record':<24}{after}")
    if made.parameters:
        lines.append("learns    standard errors of the parameters, now and as expected after:")
        lines.append(f"{'':10}{'':<12}{'now':>12}" + "".join(f"{n:>12}" for n, _ in named))
        for one in made.parameters:
            errors = one.now, one.proposed, one.aprbs, one.multisine
            lines.append(f"{'':10}{one.name:<12}" + "".join(f"{v:>12.3g}" for v in errors))
    lines += [f"note      {one}" for one in made.notes]
    if proposed.excess:
        lines.append(
            "missed    no input was found whose expected outputs hold the limits: widen them, or "
            "start elsewhere (--start)"
        )
    return {
        "run": made.run,
        "experiments": list(of),
        "sampling_time": made.sampling_time,
        "start": {"u": made.rest[0].tolist(), "y": made.rest[1].tolist()},
        "noise": made.noise.tolist(),
        "energy": found.energy,
        "expected_error": found.before,
        "records": {
            name: {
                "gain": one.gain,
                "expected_error": one.left,
                "differences": rows[name],
                "lower": one.lower.min(axis=0).tolist(),
                "upper": one.upper.max(axis=0).tolist(),
                "may_break_a_limit": bool(one.excess),
            }
            for name, one in named
        },
        "parameters": [asdict(p) for p in made.parameters],
        "text": lines,
    }
