"""Wall and processor seconds of searches, folds and unsealing; two installations side by side.

python benchmarks/searches/seconds.py demo fold unseal --repeats 3
python benchmarks/searches/seconds.py demo tanks --against ../older/.venv/bin/python

demo: 8 experiments on two_tanks_sim; fold: one grey-box fold of it in a fresh worker; unseal: of
that search; tanks: 30 experiments on cascaded_tanks; nanodrone: 12 experiments; records: 12
experiments on three generated single-input records of 2 700 samples; short: on three of 680;
workspace: six candidates written by hand and two of the library, by an agent that can read the
records of `short`, with guard records;
inductor: 10 experiments on a generated record of 10 000 samples, one input, two outputs. tanks and
nanodrone need the real data (ASIA_DATA_DIR, or a network). With --against every job runs in turns
with the package of another Python, and the ratio of the medians is printed. V is that of the best
candidate.
Processor seconds are those of the whole machine, so run nothing else (Linux only).
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from statistics import median

import numpy as np

EXPERIMENTS = {
    "demo": 8, "tanks": 30, "nanodrone": 12, "records": 12, "short": 12, "inductor": 10,
}  # fmt: skip
PROBLEMS = {"demo": "two_tanks_sim", "tanks": "cascaded_tanks", "nanodrone": "nanodrone"}
JOBS = (
    "demo", "fold", "unseal", "tanks", "nanodrone", "records", "short", "inductor", "workspace",
)  # fmt: skip
RECORDS, SAMPLING_TIME = 3, 0.01
SAMPLES = {"records": 2700, "short": 680, "inductor": 10_000}
# Run by the Python that is measured. The grey-box is the first that the expert proposes.
FOLD = """
import time
from asia.agents.library.registry import all_families
from asia.candidate import Context
from asia.judge.evaluation.evaluator import EvaluationData, Evaluator
from asia.judge.evaluation.workers import WorkerRunner
from asia.judge.executors import LocalExecutor
from asia.problem.load import load_problem
from asia.problem.folds import (make_folds)
from asia.judge.sandbox.availability import probe
from asia.search.agent_views import problem_facts
problem = load_problem("two_tanks_sim")
facts, rule = problem_facts(problem), problem.protocol
family = next(one for one in all_families() if one.name == "greybox")
source = family.trial(facts).source(family.label)
context = Context(facts.inputs, facts.outputs, facts.sampling_time, rule.past_inputs,
    rule.past_outputs, rule.horizon, rule.metric, problem.physics, seed=1)
fold = make_folds(problem.train, rule)[:1]
level = probe().level
begin = time.monotonic()
data = EvaluationData(fold, problem.train, context, rule)
found = Evaluator(data, WorkerRunner(level, problem.budget, LocalExecutor(1))).evaluate(source)
print(time.monotonic() - begin, found.outcome.value)
"""

# Run by the Python that is measured, with the folder of `searches`, a problem and a place for runs.
WORKSPACE = """
import sys, time
from pathlib import Path
sys.path.insert(0, sys.argv[1])
from candidates import CANDIDATES, Scripted
from asia.problem.load import load_problem
from asia.search.run import prepare, search
problem = load_problem(sys.argv[2], 0.15)
ready = prepare(problem, "scripted", seed=0, runs=Path(sys.argv[3]))
begin = time.monotonic()
view = search(ready, Scripted(), lambda event, view: None, lambda view: None)
print(time.monotonic() - begin, view.best_value)
"""


@dataclass(frozen=True)
class Seconds:
    """Duration and result of one run."""

    wall: float
    processor: float
    value: float


def main() -> None:
    """Measure and print a table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("jobs", nargs="*", default=["demo", "fold", "unseal"])
    parser.add_argument("--repeats", type=int, default=1)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--against", type=Path, help="the Python of another installation")
    given = parser.parse_args()
    if unknown := set(given.jobs) - set(JOBS):
        parser.error(f"unknown: {', '.join(sorted(unknown))}; known are {', '.join(JOBS)}")
    pythons = [Path(sys.executable), *([given.against.absolute()] if given.against else [])]
    print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}, medians of {given.repeats}\n")
    print("| job | wall s | processor s | V | wall of the other | processor | V | ratio of walls |")
    print("|---|---|---|---|---|---|---|---|")
    for job in given.jobs:
        columns: list[list[Seconds]] = [[] for _ in pythons]
        for _ in range(given.repeats):
            for python, column in zip(pythons, columns, strict=True):
                column.append(measured(job, python, given.seed))
        print(row(job, columns), flush=True)


def row(job: str, columns: list[list[Seconds]]) -> str:
    """One line of the table."""
    walls = [median(one.wall for one in column) for column in columns]
    cells = [job]
    for column, wall in zip(columns, walls, strict=True):
        processor = median(one.processor for one in column)
        cells += [f"{wall:.2f}", f"{processor:.2f}", f"{column[0].value:.6f}"]
    cells += ["", "", "", ""] if len(columns) == 1 else [f"{walls[1] / walls[0]:.2f}"]
    return f"| {' | '.join(cells)} |"


def measured(job: str, python: Path, seed: int) -> Seconds:
    """One run of a job from nothing."""
    with tempfile.TemporaryDirectory() as name:
        place = Path(name)
        if job == "fold":
            return timed([python, "-c", FOLD], place, own_clock=True)
        if job == "workspace":
            problem = write_records(place / "records", SAMPLES["short"])
            folder = Path(__file__).parent
            command = [python, "-c", WORKSPACE, folder, problem, place / "runs"]
            return timed(command, place, own_clock=True)
        problem = PROBLEMS.get(job, PROBLEMS["demo"])
        if job in SAMPLES:
            write = write_inductor if job == "inductor" else write_records
            problem = str(write(place / "records", SAMPLES[job]))
        asia = python.with_name("asia")
        experiments = str(EXPERIMENTS.get(job, EXPERIMENTS["demo"]))
        command = [asia, "run", problem, "--experiments", experiments, "--seed", str(seed)]
        took = timed([*command, "--runs", place / "runs"], place)
        value = best_value(next((place / "runs").glob("*/ledger.jsonl")))
        if job == "unseal":
            took = timed([asia, "unseal", "--yes", "--runs", place / "runs"], place)
        return Seconds(took.wall, took.processor, value)


def timed(command: list[str | Path], place: Path, *, own_clock: bool = False) -> Seconds:
    """Seconds of a command; own_clock: it prints its wall seconds and V."""
    before, begin = processor_seconds(), time.monotonic()
    done = subprocess.run(
        [str(word) for word in command], check=False, cwd=place, capture_output=True, text=True,
        env={**os.environ, **data_place()},
    )  # fmt: skip
    wall = time.monotonic() - begin
    if done.returncode:
        sys.exit(f"{command}: exit code {done.returncode}\n{done.stdout}\n{done.stderr}")
    processor = processor_seconds() - before
    value = float("nan")
    if own_clock:
        wall, value = (float(word) for word in done.stdout.split()[-2:])
    return Seconds(wall, processor, value)


def processor_seconds() -> float:
    """Processor time of the whole machine: a killed worker does not count for its parent."""
    user, nice, system = (int(word) for word in Path("/proc/stat").read_text().split()[1:4])
    return (user + nice + system) / os.sysconf("SC_CLK_TCK")


def data_place() -> dict[str, str]:
    """The data directory as an absolute path: the command runs elsewhere."""
    given = os.environ.get("ASIA_DATA_DIR")
    return {} if given is None else {"ASIA_DATA_DIR": str(Path(given).absolute())}


def best_value(ledger: Path) -> float:
    """V of the last candidate that was kept."""
    best = float("nan")
    for line in ledger.read_text().splitlines():
        event = json.loads(line)
        if event.get("status") == "keep":
            best = event["outcome"]["value"]
    return best


def write_records(directory: Path, samples: int) -> Path:
    """A problem with three records of a driven oscillator with a hardening spring, no equations
    given; noise 40 dB below the output."""
    directory.mkdir()
    random = np.random.default_rng(0)
    names: list[str] = []
    for i in range(RECORDS):
        steps = random.uniform(-1.0, 1.0, samples // 20) * 60.0
        u = np.repeat(steps, 20)
        y = oscillator(u)
        y = y + 0.01 * y.std() * random.standard_normal(len(y))
        names.append(f"record{i + 1}.csv")
        text = "\n".join(f"{a:.9g},{b:.9g}" for a, b in zip(u, y, strict=True))
        (directory / names[-1]).write_text(f"force,position\n{text}\n")
    (directory / "problem.toml").write_text(
        f'name = "records"\nsampling_time = {SAMPLING_TIME}\n'
        'inputs = [{ name = "force", unit = "N" }]\n'
        'outputs = [{ name = "position", unit = "m" }]\n'
        f"[data]\ntrain = {json.dumps(names)}\n"
    )
    return directory


def write_inductor(directory: Path, samples: int) -> Path:
    """A problem with one record of an inductor whose iron saturates, in series with a resistor and
    a capacitor, no equations given; noise 40 dB below the outputs."""
    directory.mkdir()
    random = np.random.default_rng(0)
    u = np.repeat(random.uniform(-12.0, 12.0, samples // 25 + 1), 25)[:samples]
    current, voltage = np.zeros((2, samples))
    flux, across, step = 0.0, 0.0, 1e-5  # mVs, V, s
    for k in range(samples):
        current[k], voltage[k] = flux + 0.2 * flux**3, across
        for _ in range(10):
            flowing = flux + 0.2 * flux**3
            flux += 1e3 * step * (u[k] - 1.5 * flowing - across)
            across += step * (flowing - across / 40.0) / 1e-4
    columns = [u]
    for y in (current, voltage):
        columns.append(y + 0.01 * y.std() * random.standard_normal(samples))
    text = "\n".join(",".join(f"{value:.9g}" for value in row) for row in np.transpose(columns))
    (directory / "record.csv").write_text(f"source,current,voltage\n{text}\n")
    (directory / "problem.toml").write_text(
        'name = "inductor"\nsampling_time = 1e-4\n'
        'inputs = [{ name = "source", unit = "V" }]\n'
        'outputs = [{ name = "current", unit = "A" }, { name = "voltage", unit = "V" }]\n'
        '[data]\ntrain = ["record.csv"]\n'
        '[protocol]\nfolds = { kind = "contiguous", count = 3 }\n'
    )
    return directory


def oscillator(u: np.ndarray) -> np.ndarray:
    """Position of a mass on a hardening spring, Runge-Kutta in ten steps a sample."""

    def rate(x: np.ndarray, force: float) -> np.ndarray:
        return np.array([x[1], force - 4.0 * x[1] - 80.0 * x[0] - 200.0 * x[0] ** 3])

    x, y, step = np.zeros(2), np.zeros(len(u)), SAMPLING_TIME / 10
    for k, force in enumerate(u):
        y[k] = x[0]
        for _ in range(10):
            a = rate(x, force)
            b = rate(x + step / 2 * a, force)
            c = rate(x + step / 2 * b, force)
            x = x + step / 6 * (a + 2 * b + 2 * c + rate(x + step * c, force))
    return y


if __name__ == "__main__":
    main()
