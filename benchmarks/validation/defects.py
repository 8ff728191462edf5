"""Does the validation report name a planted defect, and none where there is none?

Eight systems, each with one of eight defects or none, five seeds. The model has the structure of
the system without the defect, fitted to noisy records by Levenberg-Marquardt on two of three
contiguous folds at a time. The pure functions of the validation report see held-out simulations
and answers of the model, as in asia validate. Options: --seeds FIRST LAST (default 0 4;
thresholds were set on 100 to 109), --jobs, --planted to look at some rows alone, --show to print
each flag that is missed
or false.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
from collections import Counter
from dataclasses import replace
from multiprocessing import Pool

import numpy as np
from defect_systems import SAMPLES, SYSTEMS, Array, Defect, Motion, excitation, measured, run

from asia.data.segment import Segment
from asia.judge.scoring.checks.check import Cause, Check, Verdict, most_serious
from asia.judge.scoring.checks.errors import check_overfit
from asia.judge.scoring.checks.residual import residual_checks
from asia.judge.scoring.checks.response import (
    HORIZONS,
    check_frequency_response,
    check_gain,
    check_long_run,
)
from asia.judge.scoring.checks.validation_data import SimulatedSegments, without_responses

FOLDS, NOISE, ROUNDS = 3, 0.03, 12
FRICTION = 0.6

# The defect, what the record has of it, and the causes that name it.
PLANTED: dict[str, tuple[Defect, frozenset[Cause]]] = {
    "sound": (Defect(), frozenset()),
    "missing delay": (Defect(delay=4), frozenset({Cause.DYNAMICS})),
    "missing lag": (Defect(lag=0.4), frozenset({Cause.DYNAMICS})),
    "friction": (Defect(friction=FRICTION), frozenset({Cause.FRICTION})),
    "saturation": (Defect(ceiling=0.8), frozenset({Cause.STATIC})),
    "drift": (Defect(drift=0.4), frozenset({Cause.DRIFT})),
    "unstable pole": (Defect(), frozenset({Cause.UNSTABLE})),
    "wrong sign": (Defect(), frozenset({Cause.SIGN})),
    "overfit": (Defect(), frozenset({Cause.OVERFIT})),
    "drifting parameters": (Defect(change=0.8), frozenset({Cause.PARAMETERS})),
    "overfit, 2 folds": (Defect(), frozenset({Cause.OVERFIT})),
    "sound, 2 folds": (Defect(), frozenset()),
}
TWO_FOLDS = ("drifting parameters", "overfit, 2 folds", "sound, 2 folds")


def fit(system: Motion, u: Array, y: Array, weights: Array) -> Array:
    """Parameters (p, n) of n fits at once. u (T, inputs, n), y and weights (T, n)."""
    count = y.shape[1]
    best = np.tile((1.15 * np.array(system.truth))[:, None], (1, count))
    free = [k for k, value in enumerate(system.truth) if value != 0.0]
    limits = np.sort([0.02 * best[free], 50.0 * best[free]], axis=0)
    damp, loss = np.full(count, 1e-2), np.full(count, np.inf)
    theta, left, slopes = best.copy(), y.copy(), np.zeros((len(free), *y.shape))
    for _ in range(ROUNDS):
        nudge = 1e-5 * np.abs(theta)
        variants = [theta]
        for k in free:
            variants.append(theta.copy())
            variants[-1][k] += nudge[k]
        many = np.tile(u, (1, 1, len(variants)))
        outs = np.split(run(system, np.concatenate(variants, 1), many, Defect()), len(variants), 1)
        e = weights * (y - outs[0])
        now = np.sum(e * e, axis=0)
        better = now < loss
        best[:, better], left[:, better] = theta[:, better], e[:, better]
        for row, (k, moved) in enumerate(zip(free, outs[1:], strict=True)):
            slopes[row][:, better] = (weights * (moved - outs[0]) / nudge[k])[:, better]
        loss = np.minimum(now, loss)
        damp = np.clip(np.where(better, damp / 5.0, damp * 5.0), 1e-8, 1e6)
        for n in range(count):
            j = slopes[:, :, n].T
            gram = j.T @ j
            step = np.linalg.solve(gram + damp[n] * np.diag(np.diag(gram)), j.T @ left[:, n])
            theta[free, n] = np.clip(best[free, n] + step, limits[0][:, n], limits[1][:, n])
    return best


def validation_reports(number: int, planted: str, seeds: range) -> list[tuple[Check, ...]]:
    """The checks of each seed of one system."""
    system = SYSTEMS[number]
    defect = PLANTED[planted][0]
    records = []
    for seed in seeds:
        order = [*sorted(set(PLANTED) - set(TWO_FOLDS)), *TWO_FOLDS]
        names = order.index(planted), [s.name for s in SYSTEMS].index(system.name)
        random = np.random.default_rng([seed, *names])
        u = excitation(system, random)
        records.append((u, measured(system, defect, u, random, NOISE), random))
    folds = 2 if planted in TWO_FOLDS else FOLDS
    parts = np.array_split(np.arange(SAMPLES), folds)
    u = np.stack([r[0] for r in records for _ in parts], axis=2)
    y = np.stack([r[1] for r in records for _ in parts], axis=1)
    weights = np.ones_like(y)
    for n in range(y.shape[1]):
        weights[parts[n % folds], n] = 0.0
    theta = fit(system, u, y, weights)
    if planted == "wrong sign":
        theta[2] = -theta[2]
    y_hat = run(system, theta, u, Defect())
    ahead = u[: SAMPLES // folds, :, ::folds]
    long = run(system, theta[:, ::folds], np.tile(ahead, (HORIZONS, 1, 1)), Defect())
    found = []
    for k, (inputs, output, random) in enumerate(records):
        own = slice(k * folds, (k + 1) * folds)
        simulated, far = y_hat[:, own].copy(), long[:, k].copy()
        if planted == "unstable pole":
            rising = 1e-3 * output.std() * 1.002 ** np.arange(len(far))
            simulated, far = simulated + rising[:SAMPLES, None], far + rising
        if planted.startswith("overfit"):
            simulated = overfitted(inputs, output, simulated, parts, random)
        found.append(judge(inputs, output, simulated, far, parts))
    return found


def overfitted(
    u: Array, y: Array, y_hat: Array, parts: list[Array], random: np.random.Generator
) -> Array:
    """Each fold's model with two hundred and fifty random functions of the inputs more, fitted to
    what it missed on its training samples."""
    past = np.concatenate([np.roll(u, k, axis=0) for k in range(20)], axis=1)
    mixed = random.standard_normal((past.shape[1], 500))
    functions = np.tanh(past @ mixed / 2.0 + random.standard_normal(500))
    result = y_hat.copy()
    for k, held in enumerate(parts):
        train = np.setdiff1d(np.arange(len(y)), held)
        e = y[train] - y_hat[train, k]
        gains = np.linalg.lstsq(functions[train], e, rcond=None)[0]
        result[:, k] += functions @ gains
    return result


def judge(u: Array, y: Array, y_hat: Array, far: Array, parts: list[Array]) -> tuple[Check, ...]:
    """The checks that the causes come from."""
    blocks = tuple(
        Segment(u[:0], y[:0, None], u[held], y[held, None], start=int(held[0])).simulated(
            y_hat[held, k : k + 1]
        )
        for k, held in enumerate(parts)
    )
    simulations = SimulatedSegments(
        blocks, tuple(f"u{k + 1}" for k in range(u.shape[1])), ("y",), 0.05
    )
    train, held_out = [], []
    for k, held in enumerate(parts):
        e2 = (y - y_hat[:, k]) ** 2
        held_out.append(float(np.sqrt(e2[held].mean()) / y.std()))
        train.append(float(np.sqrt(np.delete(e2, held).mean()) / y.std()))
    data = replace(
        without_responses(simulations),
        lowest=y.min(keepdims=True),
        highest=y.max(keepdims=True),
        long_run=lambda: far[:, None],
    )
    return (
        *residual_checks(data),
        check_gain(data),
        check_frequency_response(data),
        check_long_run(data),
        check_overfit(train, held_out, simulations),
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs=2, default=(0, 4))
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--planted", nargs="+", choices=PLANTED, default=list(PLANTED))
    parser.add_argument("--show", action="store_true")
    options = parser.parse_args()
    seeds = range(options.seeds[0], options.seeds[1] + 1)
    print("| defect | flagged | first in the summary | another cause first, most often |")
    print("|---|---|---|---|")
    asked = [(k, planted, seeds) for planted in options.planted for k in range(len(SYSTEMS))]
    with Pool(options.jobs) as pool:
        answers = pool.starmap(validation_reports, asked, chunksize=1)
    for place, planted in enumerate(options.planted):
        own = answers[place * len(SYSTEMS) : (place + 1) * len(SYSTEMS)]
        print(row(planted, own, options.show))


def row(planted: str, answers: list[list[tuple[Check, ...]]], show: bool) -> str:
    """A line of the table."""
    causes = PLANTED[planted][1]
    flagged = first = total = 0
    others: Counter[str] = Counter()
    for system, each in zip(SYSTEMS, answers, strict=True):
        for number, checks in enumerate(each):
            raised = [c for c in checks if c.verdict in (Verdict.DOUBT, Verdict.FAIL)]
            worst = most_serious(checks)
            total += 1
            flagged += bool(raised) if not causes else any(c.cause in causes for c in raised)
            first += worst is not None and worst.cause in causes
            if worst is not None and worst.cause not in causes:
                others[worst.name] += 1
            missed = bool(raised) if not causes else not any(c.cause in causes for c in raised)
            if show and missed:
                print(
                    f"{planted}, {system.name}, {number}:",
                    *(c.sentence for c in checks),
                    sep="\n    ",
                )
    most = ", ".join(f"{name} {count}" for name, count in others.most_common(3))
    return f"| {planted} | {flagged} of {total} | {first} | {most} |"


if __name__ == "__main__":
    main()
