"""Do output bands hold the share they are meant to, and does the region of validity tell where not?

Small synthetic searches without a sandbox: eight kinds of system, four protocols; five candidates
are fitted to each fold, the lowest V wins, and its fold models and its refit are asked for a new
record of the same kind, one with a larger input and two with a faster and a slower one. Folds,
errors, region and bands are those of asia.simulate and asia unseal.

    python benchmarks/validation/bands.py --seeds 0 9
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from band_systems import KINDS, PAST, Kind, Model, fit, make_system

from asia.data import Array, Trajectory
from asia.data.segment import Segment
from asia.judge.scoring.bands import HeldOutErrors, region_of
from asia.judge.scoring.outcome import score_fold
from asia.problem.folds import Fold, make_folds, whole
from asia.problem.protocol import FoldRule, Group, ProtocolRule
from asia.search.simulation import BandBasis

LEVELS = (0.5, 0.9, 0.95)
NOMINAL = 1
CANDIDATES = ((2, 0), (4, 0), (8, 0), (2, 30), (3, 60))
"""Lags and random functions."""
TEST = 800
RAISED = 0.1
"""The share of samples outside the region from which asia validate doubts a record."""
SHIFTS = {
    "same kind": (1.0, 1.0),
    "1.5 times as large": (1.5, 1.0),
    "2.5 times as large": (2.5, 1.0),
    "4 times as fast": (1.0, 0.25),
    "4 times as slow": (1.0, 4.0),
}


@dataclass(frozen=True)
class Protocol:
    """A way to hold out, with records of some length."""

    name: str
    rule: ProtocolRule
    records: int
    samples: int


def _rule(folds: FoldRule, horizon: int | None = None) -> ProtocolRule:
    kind = "simulation" if horizon is None else "windows"
    return ProtocolRule(kind, folds, past_inputs=PAST, past_outputs=PAST, horizon=horizon)


PROTOCOLS = (
    Protocol("2 blocks", _rule(FoldRule(count=2)), 1, 800),
    Protocol("5 blocks", _rule(FoldRule(count=5)), 1, 1000),
    Protocol("4 records", _rule(FoldRule("leave_one_group_out", 4, tuple(
        Group(f"g{k}", (f"r{k}",)) for k in range(4)))), 4, 300),
    Protocol("windows of 50", _rule(FoldRule(count=3), 50), 1, 1200),
)  # fmt: skip


@dataclass(frozen=True)
class Seen:
    """Result of one system."""

    held: Array
    """Share of the samples that the bands held: (models, shifts, levels)."""
    outside: Array
    """Share of the samples outside the region of validity: (models, shifts)."""
    width: Array
    """Mean width of the bands over the deviation of the output: (models, levels), same kind."""


def simulated(model: Model, blocks: Sequence[Segment]) -> list[Array]:
    """Simulation of each block (H, ny); those of one length at once."""
    found: list[Array] = [np.zeros(0)] * len(blocks)
    for length in {len(b.y) for b in blocks}:
        alike = [k for k, b in enumerate(blocks) if len(b.y) == length]
        cases = [blocks[k] for k in alike]
        answers = model.simulate(*(np.stack([getattr(c, name) for c in cases])
                                   for name in ("past_u", "past_y", "u")))  # fmt: skip
        for k, y_hat in zip(alike, answers, strict=True):
            found[k] = y_hat
    return found


def searched(
    folds: Sequence[Fold],
) -> tuple[list[Model], list[HeldOutErrors], tuple[tuple[Array, ...], ...], tuple[int, int]]:
    """Return the fold models of the lowest V, their held-out errors and simulations, and the
    candidate."""
    best, kept = np.inf, None
    for candidate in CANDIDATES:
        models = [fit(fold.train, *candidate, seed=fold.index) for fold in folds]
        answers = [simulated(m, f.held_out) for m, f in zip(models, folds, strict=True)]
        measured = [[b.y for b in fold.held_out] for fold in folds]
        value = np.mean([
            score_fold(y, y_hat, fold.scale, "rmse").value
            for y, y_hat, fold in zip(measured, answers, folds, strict=True)
        ])  # fmt: skip
        if value < best:
            errors = [
                HeldOutErrors(tuple(y - y_hat for y, y_hat in zip(ys, y_hats, strict=True)))
                for ys, y_hats in zip(measured, answers, strict=True)
            ]
            best, kept = value, (models, errors, tuple(map(tuple, answers)), candidate)
    assert kept is not None
    return kept


def seen(kind: Kind, protocol: Protocol, seed: int) -> Seen:
    """One search and its tests."""
    numbers = KINDS.index(kind), PROTOCOLS.index(protocol)
    rng = np.random.default_rng((seed, *numbers))
    system = make_system(kind, rng)
    records = [
        Trajectory(r.u, r.y, 1.0, f"r{k}")
        for k in range(protocol.records)
        for r in [system.record(rng, protocol.samples)]
    ]
    models, errors, answers, candidate = searched(make_folds(records, protocol.rule))
    refit = fit(records, *candidate, seed=len(models))
    region = region_of([(r.u, r.y) for r in records])
    basis = BandBasis(tuple(errors), answers, region, protocol.rule.horizon is not None)
    held = np.zeros((2, len(SHIFTS), len(LEVELS)))
    outside, width = np.zeros((2, len(SHIFTS))), np.zeros((2, len(LEVELS)))
    for s, (scale, slower) in enumerate(SHIFTS.values()):
        blocks = whole([system.record(rng, TEST, scale, slower)], protocol.rule)
        each = [np.stack(one) for one in zip(*(simulated(m, blocks) for m in models), strict=True)]
        finals = ([e.mean(axis=0) for e in each], simulated(refit, blocks))
        y = np.concatenate([b.y for b in blocks])
        for f, final in enumerate(finals):
            for n, level in enumerate(LEVELS):
                if s and n != NOMINAL:
                    continue
                found = [basis.around(b.case, e, y_hat, level)
                         for b, e, y_hat in zip(blocks, each, final, strict=True)]  # fmt: skip
                low = np.concatenate([bands.lower for bands, _ in found])
                high = np.concatenate([bands.upper for bands, _ in found])
                held[f, s, n] = ((low <= y) & (y <= high)).mean()
                if s == 0:
                    width[f, n] = ((high - low) / y.std(axis=0)).mean()
            outside[f, s] = np.concatenate([out for _, out in found]).mean()
    return Seen(held, outside, width)


def share(values: Array) -> str:
    """Mean with its 95 % interval over systems, in percent."""
    reach = 1.96 * values.std(ddof=1) / np.sqrt(len(values))
    mean = values.mean()
    return f"{100 * mean:.1f} ({100 * (mean - reach):.1f} to {100 * (mean + reach):.1f})"


def coverage(name: str, rows: Sequence[Seen]) -> str:
    """A line of the first table."""
    held = np.stack([r.held for r in rows])[:, :, 0]
    width = np.stack([r.width for r in rows])
    own = held[:, 1, NOMINAL]
    cells = [name, str(len(rows)), share(own), f"{100 * np.mean(own < 0.8):.0f}"]
    cells += [f"{100 * held[:, 0, NOMINAL].mean():.1f}"]
    cells += [f"{100 * held[:, 1, n].mean():.1f}" for n in range(len(LEVELS)) if n != NOMINAL]
    return f"| {' | '.join([*cells, f'{np.median(width[:, 1, NOMINAL]):.2f}'])} |"


def flags(name: str, s: int, rows: Sequence[Seen]) -> str:
    """A line of the second table."""
    held = np.array([r.held[1, s, NOMINAL] for r in rows])
    raised = np.array([r.outside[1, s] for r in rows]) > RAISED
    low = held < 0.87
    among = f"{raised[low].sum()} of {low.sum()}"
    far = held < 0.8
    cells = [name, f"{100 * held.mean():.1f}", f"{raised.sum()} of {len(rows)}", among,
             f"{raised[far].sum()} of {far.sum()}"]  # fmt: skip
    return f"| {' | '.join(cells)} |"


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs=2, default=(0, 9))
    parser.add_argument("--protocols", nargs="+", type=int, default=range(len(PROTOCOLS)))
    options = parser.parse_args()
    seeds = range(options.seeds[0], options.seeds[1] + 1)
    found = {
        (kind.name, PROTOCOLS[p].name, seed): seen(kind, PROTOCOLS[p], seed)
        for kind in KINDS
        for p in options.protocols
        for seed in seeds
    }
    print("| systems | number | refit, 90 % | below 80 %, % of systems | ensemble, 90 % | 50 % | "
          "95 % | width at 90 % |")  # fmt: skip
    print("|---|---|---|---|---|---|---|---|")
    for place, names in ((0, [k.name for k in KINDS]), (1, [p.name for p in PROTOCOLS])):
        for name in names:
            own = [row for key, row in found.items() if key[place] == name]
            if own:
                print(coverage(name, own))
    print(coverage("**all**", list(found.values())))
    print("\n| test input | coverage, % | flag rises | of those below 87 % | of those below 80 % |")
    print("|---|---|---|---|---|")
    for s, name in enumerate(SHIFTS):
        print(flags(name, s, list(found.values())))


if __name__ == "__main__":
    main()
