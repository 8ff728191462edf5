"""Kill workers, scheduler and search of a Dask cluster at random, and compare what comes out.

python benchmarks/machinery/kill_cluster.py [--kills 100] [--experiments 15] [--seed 0]
    [--workers 2] [--parallel 4] [--isolation process] [--out DIR]

One search runs undisturbed, with workers of its own. The same search then runs through a Dask
cluster on this machine. At random moments one of its parts is killed (SIGKILL):

worker     another one is started at once, and the search must go on;
search     it must leave no process here, and is started again;
scheduler  its workers and the search must end by themselves, the search with a sentence; then all
           are started again.

So on until the kills are used up; a search that ends is compared and the next one begun. Each
search must hold the same records as the undisturbed one (time, seconds, machines and the moments
at which first fits land apart), the same artifacts and generated files, must verify, must have
kept every record that was there at a kill, must have proposed, landed and evaluated no experiment
twice and lost none. Prints a table; exits with 1 on any difference. Extra: dask.
"""

from __future__ import annotations

import argparse
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from asia.errors import UserError
from asia.judge.executors.dask import DaskExecutor
from kill_common import (
    UNDISTURBED,
    Bench,
    below,
    check_prefix,
    compare,
    events,
    outliving,
    whole_lines,
    write_problem,
)

DASK = str(Path(sys.executable).with_name("dask"))
VICTIMS = ("worker", "scheduler", "search")
START_SECONDS = 60.0
# A search whose scheduler died looks for it for half a minute.
END_SECONDS = 120.0
# Kills fall into this share of an undisturbed search, so that most searches meet several.
SHARE = 0.5
PATIENCE = 1.2


@dataclass(frozen=True)
class ClusterKill:
    """One kill: seconds after the last start or kill, records on disk, processes that outlived it,
    and the seconds in which a search without its scheduler ended."""

    search: str
    victim: str
    after: float
    records: int
    left: int
    ending: float | None = None


@dataclass
class KillCluster:
    """A scheduler and workers of one thread each on this machine."""

    folder: Path
    count: int
    scheduler: subprocess.Popen[bytes] | None = None
    workers: list[subprocess.Popen[bytes]] = field(default_factory=list)

    @property
    def file(self) -> Path:
        """File in which the scheduler writes its address."""
        return self.folder / "scheduler.json"

    def start(self) -> None:
        """All of it; returns once every worker is there."""
        self.file.unlink(missing_ok=True)
        self.scheduler = self._start("scheduler", "--port", "0", "--host", "127.0.0.1")
        for _ in range(self.count):
            self.add_worker()
        end = time.monotonic() + START_SECONDS
        while not self._complete():
            if time.monotonic() > end:
                sys.exit(f"the cluster did not start: see {self.folder / 'dask.log'}")
            time.sleep(0.3)

    def add_worker(self) -> None:
        """One more worker."""
        # Without the last option a worker that starts looks for its scheduler for ever.
        words = ("--nthreads", "1", "--no-nanny", "--death-timeout", "20")
        self.workers.append(self._start("worker", *words))

    def kill_worker(self, place: int) -> int:
        """SIGKILL to one worker; how many processes outlived it."""
        return _kill([self.workers.pop(place)])

    def kill_scheduler(self) -> int:
        """SIGKILL to the scheduler; how many processes of its workers outlived it."""
        assert self.scheduler is not None
        alive = {k: v for worker in self.workers for k, v in below(worker.pid).items()}
        _kill([self.scheduler])
        end = time.monotonic() + START_SECONDS
        while time.monotonic() < end and any(w.poll() is None for w in self.workers):
            time.sleep(0.1)
        left = len(outliving(alive))
        _kill(self.workers)
        self.workers.clear()
        return left

    def close(self) -> None:
        """End all of it."""
        _kill([*self.workers, *([self.scheduler] if self.scheduler else [])])

    def _start(self, *words: str) -> subprocess.Popen[bytes]:
        common = ("--no-dashboard", "--scheduler-file", str(self.file))
        with (self.folder / "dask.log").open("ab") as log:
            return subprocess.Popen(
                [DASK, *words, *common], stdout=log, stderr=log, start_new_session=True
            )

    def _complete(self) -> bool:
        try:
            executor = DaskExecutor(str(self.file))
        except UserError:
            return False
        try:
            return len(executor.ask_each(_said, b"")) == self.count
        finally:
            executor.close()


def main() -> int:
    """Run, compare, print; 1 when anything differs."""
    options = _options()
    out = Path(options.out or tempfile.mkdtemp(prefix="asia-kill-cluster-"))
    problem = write_problem(out / "problem")
    command = [sys.executable, str(Path(__file__).with_name("kill_cheap.py")), str(problem)]
    command += ["--experiments", str(options.experiments), "--seed", str(options.seed)]
    command += ["--parallel", str(options.parallel)]
    command += ["--isolation", options.isolation] if options.isolation else []
    bench = Bench((*command, "--executor", "local"), out, np.random.default_rng(options.seed))
    begin = time.monotonic()
    if bench.start(out / UNDISTURBED).wait() != 0:
        sys.exit(f"the undisturbed search failed: see {out / UNDISTURBED}.log")
    duration = time.monotonic() - begin
    expected = events(out / UNDISTURBED)
    print(f"undisturbed search: {len(expected)} records, {duration:.1f} s; files in {out}")
    cluster = KillCluster(out, options.workers)
    bench = replace(bench, command=(*command, "--executor", f"dask:{cluster.file}"))
    try:
        kills = _kill_often(bench, cluster, options.kills, SHARE * duration, expected)
    finally:
        cluster.close()
    _print_table(kills)
    for fault in bench.faults:
        print(f"DIFFERENT  {fault}")
    verdict = f"{len(bench.faults)} differences" if bench.faults else "all the same, all verify"
    print(
        f"{len(kills)} kills over {len({k.search for k in kills})} searches of "
        f"{options.experiments} experiments in {time.monotonic() - begin:.0f} s: {verdict}"
    )
    if options.out is None and not bench.faults:
        shutil.rmtree(out)
    return 1 if bench.faults else 0


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--experiments", type=int, default=15)
    parser.add_argument("--seed", type=int, default=0, help="of the search, moments and victims")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--parallel", type=int, default=4)
    parser.add_argument("--isolation", help="a level instead of the strongest: process")
    parser.add_argument("--out", help="an empty directory; default: a temporary one")
    return parser.parse_args()


def _kill_often(
    bench: Bench,
    cluster: KillCluster,
    count: int,
    longest: float,
    expected: list[dict[str, Any]],
) -> list[ClusterKill]:
    cluster.start()
    kills: list[ClusterKill] = []
    number = 0
    while len(kills) < count:
        number += 1
        runs = bench.out / f"search{number}"
        process = bench.start(runs)
        reach, grown = longest, 0
        while True:
            after = float(bench.random.uniform(0.0, reach)) if len(kills) < count else None
            before = whole_lines(runs)
            try:
                code = process.wait(after or END_SECONDS + 20 * longest)
            except subprocess.TimeoutExpired:
                if after is None:
                    bench.fault(runs, "does not come to its end")
                    _kill([process])
                    break
                process, kill = _kill_one(bench, cluster, runs, process, after)
                kills.append(kill)
                # On a loaded machine kills would leave no time for a single experiment.
                reach = longest if kill.records > grown else PATIENCE * reach
                grown = kill.records
                words = f"{kill.victim} of {runs.name} at {after:.2f} s, {kill.records} records"
                print(f"kill {len(kills)}/{count}: {words}", file=sys.stderr, flush=True)
                check_prefix(bench, runs, before)
                continue
            check_prefix(bench, runs, before)
            if code != 0:
                bench.fault(runs, f"ended with exit code {code}: see {runs.name}.log")
            break
        compare(bench, runs, expected)
    return kills


def _kill_one(
    bench: Bench,
    cluster: KillCluster,
    runs: Path,
    process: subprocess.Popen[bytes],
    after: float,
) -> tuple[subprocess.Popen[bytes], ClusterKill]:
    """Kill a part, put another one in its place; the search that goes on."""
    victim = str(bench.random.choice(VICTIMS))
    ending = None
    if victim == "worker":
        left = cluster.kill_worker(int(bench.random.integers(len(cluster.workers))))
        cluster.add_worker()
    elif victim == "search":
        left = _kill([process])
        process = bench.start(runs)
    else:
        begin = time.monotonic()
        left = cluster.kill_scheduler()
        _check_ending(bench, runs, process)
        ending = time.monotonic() - begin
        cluster.start()
        process = bench.start(runs)
    if left:
        bench.fault(runs, f"{left} processes outlived the kill of a {victim}")
    return process, ClusterKill(runs.name, victim, after, len(whole_lines(runs)), left, ending)


def _check_ending(bench: Bench, runs: Path, process: subprocess.Popen[bytes]) -> None:
    """A search whose scheduler died says so and ends, unless it had its last fold already."""
    try:
        code = process.wait(END_SECONDS)
    except subprocess.TimeoutExpired:
        bench.fault(runs, f"still runs {END_SECONDS:.0f} s after its scheduler was killed")
        _kill([process])
        return
    lines = (bench.out / f"{runs.name}.log").read_text(errors="replace").splitlines()
    if code != 0 and not (lines and lines[-1].startswith("asia: ")):
        bench.fault(runs, f"ended without a sentence (exit code {code}): see {runs.name}.log")


def _kill(processes: list[subprocess.Popen[bytes]]) -> int:
    """SIGKILL to whole process groups; how many processes outlived it."""
    alive: dict[tuple[int, str], str] = {}
    for process in processes:
        if process.poll() is None:
            # Stopped first: nothing new is started between the look and the kill.
            os.killpg(process.pid, signal.SIGSTOP)
            alive |= below(process.pid)
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    return len(outliving(alive))


def _print_table(kills: list[ClusterKill]) -> None:
    """How many kills of which part, after how many records, and what was left."""
    print(f"{'killed':<12}{'kills':>6}{'records then':>14}{'left':>6}{'search ended, s':>18}")
    for victim in VICTIMS:
        found = [k for k in kills if k.victim == victim]
        if not found:
            continue
        records = [k.records for k in found]
        endings = [k.ending for k in found if k.ending is not None]
        span = f"{min(endings):.0f} to {max(endings):.0f}" if endings else "-"
        print(
            f"{victim:<12}{len(found):>6}{f'{min(records)} to {max(records)}':>14}"
            f"{sum(k.left for k in found):>6}{span:>18}"
        )


def _said(request: bytes) -> bytes:
    return request


if __name__ == "__main__":
    sys.exit(main())
