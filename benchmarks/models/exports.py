"""Every family of the library, fitted small on three problems, exported to every target.

python benchmarks/models/exports.py [--families linear,narx] [--targets c,fmu]

The problems: a long simulation, windows of 20 samples, and two inputs with two outputs. For each
family the largest difference of the exported files from ASIA's own simulation on the training
windows, over the spread of the measured outputs. Progress goes to stderr, the table as Markdown to
stdout. Targets whose programs are not installed are left out.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import types
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import jax
import numpy as np

from asia.agents.library.family import Family
from asia.agents.library.registry import all_families
from asia.candidate import Context
from asia.data import Signal, Trajectory
from asia.data.segment import SimulatedSegment
from asia.errors import UserError
from asia.export.model import ExportModel
from asia.export.pipeline import TARGETS, Ready, write
from asia.lowering.program import LoweredModel
from asia.lowering.trace import lowered_bytes
from asia.lowering.wire import unpack
from asia.testing.family import family_problem, smallest_source

PAST, HORIZON, LONG = 5, 20, 100


@dataclass(frozen=True)
class Setting:
    """A problem to fit a family to."""

    name: str
    record: Trajectory
    context: Context


def main() -> None:
    """Fit, export and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, add_help=True)
    parser.add_argument("--families", default="")
    parser.add_argument("--targets", default=",".join(TARGETS))
    options = parser.parse_args()
    chosen = options.families.split(",") if options.families else None
    targets = [t for t in options.targets.split(",") if TARGETS[t].missing() is None]
    print(f"| family | problem | {' | '.join(targets)} |")
    print(f"| {' | '.join(['---'] * (2 + len(targets)))} |")
    for family in all_families():
        if chosen is None or family.name in chosen:
            for setting in settings(family):
                cells = exported(family, setting, targets)
                print(f"| {family.name} | {setting.name} | {' | '.join(cells)} |", flush=True)


def settings(family: Family) -> list[Setting]:
    """The problems that the family is made for."""
    record, context = family_problem(family)
    found = [
        Setting("long", record, context),
        Setting("windows", record, replace(context, horizon=HORIZON)),
    ]
    if "physics" not in family.needs and "several" not in family.needs:
        found.append(mimo())
    return found


def mimo() -> Setting:
    """Two coupled lags whose inputs saturate."""
    rng = np.random.default_rng(5)
    u = np.repeat(rng.uniform(-1, 1, (20, 2)), 10, axis=0)
    x = np.zeros((len(u), 2))
    a, b = np.array([[0.8, 0.1], [-0.1, 0.7]]), np.array([[0.3, 0.1], [0.0, 0.4]])
    for k in range(len(u) - 1):
        x[k + 1] = x[k] @ a.T + np.tanh(2.0 * u[k]) @ b.T
    y = x + 0.002 * rng.standard_normal(x.shape)
    names = [(Signal(f"{side}1"), Signal(f"{side}2")) for side in "uy"]
    context = Context(names[0], names[1], 0.1, PAST, PAST, seed=1)
    return Setting("two by two", Trajectory(u, y, 0.1, "lags"), context)


def exported(family: Family, setting: Setting, targets: Sequence[str]) -> list[str]:
    """A cell for each target."""
    wide = jax.config.jax_enable_x64
    try:
        given = ready(family, setting)
        if isinstance(given, str):
            return [given, *[""] * (len(targets) - 1)]
        return [_cell(target, given) for target in targets]
    finally:
        jax.config.update("jax_enable_x64", wide)


def _cell(target: str, given: Ready) -> str:
    with tempfile.TemporaryDirectory(prefix="asia-exports-") as made:
        try:
            rows = write(TARGETS[target], given, Path(made) / target).parity
        except UserError as error:
            print(f"{given.model.name} {target}: {error}", file=sys.stderr, flush=True)
            return "refused"
    return ", ".join("-" if r.difference is None else f"{r.difference:.0e}" for r in rows)


def ready(family: Family, setting: Setting) -> Ready | str:
    """The family fitted at the size of tests, lowered, with two windows to compare on; a sentence
    where it cannot be."""
    record, context = setting.record, setting.context
    module = types.ModuleType(family.name)
    exec(smallest_source(family, record, context), module.__dict__)
    model = module.fit([record], context)
    low = unpack(lowered_bytes(model, context.n_past_u, context.n_past_y, context.nu, context.ny))
    if not isinstance(low, LoweredModel):
        return str(low)
    length = LONG if context.horizon is None else context.horizon
    past = max(context.n_past_u, context.n_past_y)
    windows: list[SimulatedSegment] = []
    for start in (past, past + length // 2):
        past_u = record.u[start - context.n_past_u : start]
        past_y = record.y[start - context.n_past_y : start]
        u, y = (side[start : start + length] for side in (record.u, record.y))
        y_hat = model.simulate(past_u[None], past_y[None], u[None])[0]
        windows.append(SimulatedSegment(past_u, past_y, u, y, y_hat=y_hat))
    spans = [np.stack([s.min(axis=0), s.max(axis=0)], axis=1) for s in (record.u, record.y)]
    export = ExportModel(
        f"{family.name}, {setting.name}", "refit", "made_up", low, context.inputs,
        context.outputs, context.sampling_time, spans[0], spans[1], windows[0].part(0, 10),
    )  # fmt: skip
    return Ready(export, tuple(windows))


if __name__ == "__main__":
    main()
