"""The pictures of `tools.py --plot`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from asia.data import Array
from asia.problem.load import Problem
from asia.protocol import Block
from asia.report import SimulatedCase, SimulatedCases, draw_cases, simulated_cases
from asia.tools._local import LocalFold

_MOST_BLOCKS = 300


def draw(
    folder: Path, problem: Problem, title: str, folds: Sequence[LocalFold], *, held_out: bool
) -> tuple[str, ...]:
    """Simulation and residuals of each fold, written into `plots/`; the names of the files."""
    cases: list[SimulatedCase] = []
    for one in folds:
        cases += simulated_cases(one.fold, *_some(one.training, one.training_y_hat), held_out=False)
        if held_out:
            held = _some(one.fold.validation, one.y_hat)
            cases += simulated_cases(one.fold, *held, held_out=True)
    shown = SimulatedCases(
        title=title,
        sampling_time=problem.sampling_time,
        windows=problem.protocol.horizon is not None,
        inputs=problem.inputs,
        outputs=problem.outputs,
        cases=tuple(cases),
    )
    names: list[str] = []
    (folder / "plots").mkdir(exist_ok=True)
    for what, picture in draw_cases(shown).items():
        names.append(f"plots/tools{'' if what == 'simulation' else f'-{what}'}.png")
        (folder / names[-1]).write_bytes(picture)
    return tuple(names)


def _some(
    blocks: Sequence[Block], y_hat: Sequence[Array]
) -> tuple[Sequence[Block], Sequence[Array]]:
    """Select some of many windows, evenly spaced."""
    every = -(-len(blocks) // _MOST_BLOCKS)
    return blocks[::every], y_hat[::every]
