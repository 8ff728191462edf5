"""Long records and long searches: memory, seconds and sizes of whole searches.

python benchmarks/machinery/scale.py record [--samples 1000000] [--parallel 1]
    [--executor local:2] [--out DIR]
python benchmarks/machinery/scale.py search [--experiments 1000] [--parallel 1]
    [--executor local:2] [--isolation process] [--out DIR]

`record`: a search of three experiments (NumPy baseline, linear and neural state-space model, few
steps) on one simulated record, 2 folds. Memory is the proportional set size of the search and all
its processes together, so that shared pages count once, looked at ten times a second; its peak in
each step of the search. The same search on a record of 2 000 samples gives the part that does not
grow with the record. What is left is given as a multiple of the record's own size in float64.

`search`: experiments that cost milliseconds. Experiments a second and processor seconds by
activity, in each quarter of the search, so that what grows with their number shows; sizes of the
ledger and of the artifacts; seconds of `asia status` and `asia show`. The load is printed.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections import defaultdict
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path

import numpy as np

from asia.agents import AgentView, Proposal
from asia.judge.executors import make_executor
from asia.ledger.events import Evaluated, Event
from asia.ledger.run import open_run
from asia.ledger.view import SearchView
from asia.problem.load import load_problem
from asia.search.run import prepare, search
from kill_cheap import NAME
from kill_common import ASIA, below, write_problem

SHORT = 2_000
LOOK_SECONDS = 0.1
LEAST_SQUARES = """
import numpy as np


class Model:
    def __init__(self, gain):
        self.gain = gain

    def simulate(self, past_u, past_y, u):
        return self.gain * u[:, :, :1]


def fit(trajectories, context):
    u = np.concatenate([t.u[:, :1] for t in trajectories])
    y = np.concatenate([t.y for t in trajectories])
    return Model(float((u * y).sum() / (u * u).sum()))
"""
LINEAR = """
from asia.models import linear
from asia.models.methods import LevenbergMarquardt


def fit(trajectories, context):
    model = linear.build(linear.Config(order=2), context)
    return linear.train(model, trajectories, context, LevenbergMarquardt(iterations=5))
"""
NEURAL = """
from asia.models import neural_ss
from asia.models.methods import Adam


def fit(trajectories, context):
    model = neural_ss.build(neural_ss.Config(order=2), context)
    return neural_ss.train(model, trajectories, context, Adam(steps=20, truncation=200))
"""


@dataclass(frozen=True)
class LongRecordAgent:
    """A linear, then a neural model."""

    name: str = "long"
    proposes_ahead: bool = True

    def propose(self, view: AgentView) -> Proposal | None:
        """As every agent."""
        sources = (LINEAR, NEURAL)
        names = ("linear", "neural_ss")
        place = len(view.proposed) - 1
        if place >= len(sources):
            return None
        return Proposal(sources[place], names[place], names[place], "It fits.", "A lower V.")


@dataclass
class MemoryWatch:
    """The largest sum of proportional set sizes below a process, in MB, in each step."""

    root: int
    step: str = "load"
    peaks: dict[str, float] = field(default_factory=lambda: defaultdict(float))
    parts: dict[str, list[float]] = field(default_factory=dict)
    over: threading.Event = field(default_factory=threading.Event)

    def look(self) -> None:
        """Until it is over."""
        while not self.over.wait(LOOK_SECONDS):
            sizes = sorted((_pss_mb(pid) for pid, _ in below(self.root)), reverse=True)
            if sum(sizes) > self.peaks[self.step]:
                self.peaks[self.step] = sum(sizes)
                self.parts[self.step] = sizes


def main() -> None:
    """Measure and print."""
    options = _options()
    if options.child:
        _search_record(options)
        return
    out = Path(options.out or tempfile.mkdtemp(prefix="asia-scale-"))
    out.mkdir(exist_ok=True)
    print(f"load before {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")
    (_measure_record if options.what == "record" else _measure_search)(out, options)
    print(f"load after {os.getloadavg()[0]:.1f}")
    if options.out is None:
        shutil.rmtree(out)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("what", choices=("record", "search"))
    parser.add_argument("--samples", type=int, default=1_000_000)
    parser.add_argument("--experiments", type=int, default=1_000)
    parser.add_argument("--parallel", type=int, default=1)
    parser.add_argument("--executor", default="local:2")
    parser.add_argument("--isolation", help="a level instead of the strongest: process")
    parser.add_argument("--out", help="a directory to keep; default: a temporary one")
    parser.add_argument("--child", help=argparse.SUPPRESS)
    return parser.parse_args()


def _measure_record(out: Path, options: argparse.Namespace) -> None:
    size = 2 * 8 * options.samples / 1e6
    short, _ = _watched(out, SHORT, options)
    long, wall = _watched(out, options.samples, options)
    print(f"{options.samples} samples of 2 signals, {size:.0f} MB; the search took {wall:.0f} s")
    print(f"{'step':<26}{'peak, MB':>10}{'short record':>14}{'rest over data':>16}")
    for step, peak in long.peaks.items():
        fixed = short.peaks.get(step, 0.0)
        print(f"{step:<26}{peak:>10.0f}{fixed:>14.0f}{(peak - fixed) / size:>16.1f}")
        print(f"{'':<26}processes {', '.join(f'{x:.0f}' for x in long.parts[step] if x > 5)}")


def _watched(out: Path, samples: int, options: argparse.Namespace) -> tuple[MemoryWatch, float]:
    """The search on a record of so many samples, in a process of its own; its seconds."""
    problem = _write_record(out / f"record{samples}", samples)
    command = [sys.executable, __file__, "record", "--child", str(problem)]
    command += ["--parallel", str(options.parallel), "--executor", options.executor]
    begin = time.monotonic()
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    watch = MemoryWatch(process.pid)
    thread = threading.Thread(target=watch.look)
    thread.start()
    assert process.stdout is not None
    for line in process.stdout:
        print(f"{time.monotonic() - begin:8.1f} s  {line.strip()}", file=sys.stderr)
        watch.step = line.strip()
    code = process.wait()
    watch.over.set()
    thread.join()
    if code != 0:
        sys.exit(f"the search on {samples} samples failed")
    return watch, time.monotonic() - begin


def _write_record(directory: Path, samples: int) -> Path:
    """A resonance with a softening output and a little noise, as a CSV file."""
    random = np.random.default_rng(0)
    u = np.repeat(random.uniform(-1.0, 1.0, samples // 10 + 1), 10)[:samples]
    y, a, b = np.empty(samples), 0.0, 0.0
    for k, value in enumerate(u.tolist()):
        y[k] = a
        a, b = a + 0.3 * b, -0.3 * a + 0.7 * b + 0.3 * value
    table = np.stack([u, np.tanh(y) + 0.02 * random.standard_normal(samples)], axis=1)
    directory.mkdir(parents=True)
    np.savetxt(directory / "train.csv", table, "%.6g", ",", header="u,y", comments="")
    (directory / "problem.toml").write_text(
        f'name = "record{samples}"\nsampling_time = 0.1\ninputs = ["u"]\noutputs = ["y"]\n'
        '[data]\ntrain = ["train.csv"]\n[protocol]\npast_inputs = 10\npast_outputs = 10\n'
        "folds = { kind = 'contiguous', count = 2 }\n"
        "[budget]\nexperiments = 3\nfit_seconds = 3600\nmemory_mb = 8192\nretests = 0\n"
    )
    (directory / "baseline.py").write_text(LEAST_SQUARES)
    return directory


def _search_record(options: argparse.Namespace) -> None:
    """In the process that is watched: a line at each step."""
    problem = load_problem(Path(options.child))
    runs = Path(options.child) / "runs"
    agent = LongRecordAgent()

    def told(event: Event, view: SearchView) -> None:
        families = {e.number: e.proposed.family for e in view.experiments}
        if event.event == "proposed":
            print(f"experiment {families[len(view.experiments)]}", flush=True)
        elif event.event in ("started", "stopped"):
            print({"started": "references", "stopped": "refit"}[event.event], flush=True)

    ready = prepare(problem, agent.name, seed=0, runs=runs, parallel=options.parallel)
    print("references", flush=True)
    view = search(ready, agent, told, lambda view: None, make_executor(options.executor))
    for e in view.finished:
        if e.score is None:
            sys.exit(f"{e.proposed.family} failed: {e.result.outcome if e.result else None}")


def _pss_mb(pid: int) -> float:
    try:
        lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    except OSError:
        return 0.0
    return next((int(x.split()[1]) / 1e3 for x in lines if x.startswith("Pss:")), 0.0)


def _measure_search(out: Path, options: argparse.Namespace) -> None:
    problem, runs = write_problem(out / "problem"), out / "runs"
    command = [sys.executable, str(Path(__file__).with_name("kill_cheap.py")), str(problem)]
    command += ["--runs", str(runs), "--experiments", str(options.experiments), "--seed", "0"]
    command += ["--parallel", str(options.parallel), "--executor", options.executor]
    command += ["--isolation", options.isolation] if options.isolation else []
    begin = time.monotonic()
    subprocess.run(command, check=True)
    wall = time.monotonic() - begin
    directory = runs / NAME
    _print_quarters(directory)
    ledger = (directory / "ledger.jsonl").stat().st_size
    artifacts = [path.stat().st_size for path in (directory / "artifacts").iterdir()]
    count = options.experiments
    print(f"{count} experiments in {wall:.0f} s: {count / wall:.2f} a second")
    print(f"ledger {ledger / 1e6:.1f} MB, {ledger / count / 1e3:.1f} kB an experiment")
    print(f"{len(artifacts)} artifacts, {sum(artifacts) / 1e6:.1f} MB")
    for words in (["status"], ["status", "--json"], ["show"], ["verify"]):
        seconds = [_seconds([ASIA, words[0], NAME, *words[1:], "--runs", str(runs)]) for _ in "123"]
        print(f"asia {' '.join(words):<16}{min(seconds):6.2f} s (first {seconds[0]:.2f} s)")


def _print_quarters(directory: Path) -> None:
    lines = [line for line in open_run(directory).lines if isinstance(line.event, Evaluated)]
    kinds = sorted({s.activity.value for line in lines for s in line.event.spent})
    print(f"{'experiments':<14}{'a second':>9}  processor seconds of an experiment")
    for part in np.array_split(np.arange(1, len(lines)), 4):
        first, last = (
            datetime.fromisoformat(lines[place].time) for place in (part[0] - 1, part[-1])
        )
        spent = dict.fromkeys(kinds, 0.0)
        for place in part:
            for one in lines[place].event.spent:
                spent[one.activity.value] += one.processor / len(part)
        words = ", ".join(f"{k} {v:.3f}" for k, v in spent.items() if v >= 5e-4)
        rate = len(part) / (last - first).total_seconds()
        print(f"{f'{part[0] + 1} to {part[-1] + 1}':<14}{rate:>9.2f}  {words}")


def _seconds(command: list[str]) -> float:
    begin = time.monotonic()
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return time.monotonic() - begin


if __name__ == "__main__":
    main()
