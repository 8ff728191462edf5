"""Kill searches at random moments and see whether their ledgers come out the same.

python benchmarks/machinery/kill.py [--kills 200] [--experiments 15] [--seed 0] [--agent cheap]
    [--isolation process] [--out DIR]
python benchmarks/machinery/kill.py --starts 300 [--seed 0]

One search runs undisturbed. The same search then runs again elsewhere, its whole process group
is killed (SIGKILL) at a random moment, and it is started again, until the kills are used up; a
search that ends before its kill is compared and the next one begun. Each search, once at its end,
must hold the same events as the undisturbed one (time, seconds and what a run draws for itself
apart), the same generated files and the same artifacts, must verify, must have kept every record
that was there at a kill, must have evaluated no experiment twice and lost none, and no process may
outlive its kill. Prints a table; exits with 1 on any difference.

The agent `cheap` proposes NumPy models that fit in milliseconds, with a crash, an exit and a twin
among them, so that most kills fall between and into the steps of the search; any other name is
an agent of `asia run`.

With --starts, processes that do nothing but start workers behind namespaces are killed instead, 0
to 30 ms after the first order: the moments in which bubblewrap sets up. Prints how many processes
are left; exits with 1 on any.
"""

from __future__ import annotations

import argparse
import json
import os
import secrets
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from asia.judge.sandbox.availability import open_worker
from asia.judge.sandbox.types import Isolation, Limits
from asia.judge.sandbox.worker import process as orphans
from kill_cheap import NAME
from kill_common import (
    ASIA,
    DIE_SECONDS,
    UNDISTURBED,
    Bench,
    below,
    check_prefix,
    compare,
    events,
    outliving,
    processes,
    whole_lines,
    write_problem,
)

CHEAP = "cheap"
# Kills fall into this share of an undisturbed search, so that most searches meet several.
SHARE = 0.6
LONGEST_START_SECONDS = 0.03


@dataclass(frozen=True)
class Kill:
    """One kill: seconds after the start, records on disk, workers alive then and afterwards."""

    search: str
    after: float
    records: int
    last: str
    processes: int
    left: int


def main() -> int:
    """Run, compare, print; 1 when anything differs."""
    options = _options()
    if options.starts:
        return _kill_starts(options.starts, np.random.default_rng(options.seed))
    out = Path(options.out or tempfile.mkdtemp(prefix="asia-kill-"))
    problem = write_problem(out / "problem")
    if options.agent == CHEAP:
        command = [sys.executable, str(Path(__file__).with_name("kill_cheap.py")), str(problem)]
    else:
        command = [ASIA, "run", str(problem), "--agent", options.agent, "--name", NAME]
    command += ["--experiments", str(options.experiments), "--seed", str(options.seed)]
    command += ["--isolation", options.isolation] if options.isolation else []
    bench = Bench(tuple(command), out, np.random.default_rng(options.seed))
    begin = time.monotonic()
    reference = out / UNDISTURBED
    _finish(bench, reference)
    duration = time.monotonic() - begin
    expected = events(reference)
    print(f"undisturbed search: {len(expected)} records, {duration:.1f} s; files in {out}")
    kills = _kill_often(bench, options.kills, SHARE * duration, expected)
    _print_table(kills)
    for fault in bench.faults:
        print(f"DIFFERENT  {fault}")
    searches = len({k.search for k in kills})
    verdict = f"{len(bench.faults)} differences" if bench.faults else "all the same, all verify"
    print(
        f"{len(kills)} kills over {searches} searches of {options.experiments} experiments in "
        f"{time.monotonic() - begin:.0f} s: {verdict}"
    )
    if options.out is None and not bench.faults:
        shutil.rmtree(out)
    return 1 if bench.faults else 0


def _print_table(kills: list[Kill]) -> None:
    """How many kills fell behind which record, in how many living processes, and what was left."""
    head = f"{'killed behind':<16}{'kills':>6}{'earliest s':>12}{'latest s':>10}"
    print(f"{head}{'alive':>8}{'left':>6}")
    for kind in dict.fromkeys(sorted(k.last.split()[0] for k in kills)):
        found = [k for k in kills if k.last.split()[0] == kind]
        times = [k.after for k in found]
        alive = [k.processes for k in found]
        print(
            f"{kind:<16}{len(found):>6}{min(times):>12.2f}{max(times):>10.2f}"
            f"{f'{min(alive)}-{max(alive)}':>8}{sum(k.left for k in found):>6}"
        )


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--starts", type=int, default=0, help="kill starts of workers instead")
    parser.add_argument("--experiments", type=int, default=15)
    parser.add_argument("--seed", type=int, default=0, help="of the search and of the moments")
    parser.add_argument("--agent", default=CHEAP)
    parser.add_argument("--isolation", help="a level instead of the strongest: process")
    parser.add_argument("--out", help="an empty directory; default: a temporary one")
    return parser.parse_args()


def _kill_often(
    bench: Bench, count: int, longest: float, expected: list[dict[str, Any]]
) -> list[Kill]:
    kills: list[Kill] = []
    number = 0
    while len(kills) < count:
        number += 1
        runs = bench.out / f"search{number}"
        ended = False
        while len(kills) < count and not ended:
            kill = _kill_once(bench, runs, float(bench.random.uniform(0.0, longest)))
            ended = kill is None
            if kill is not None:
                kills.append(kill)
                words = f"{kill.search} at {kill.after:.2f} s behind {kill.last}"
                print(f"kill {len(kills)}/{count}: {words}", file=sys.stderr, flush=True)
        if not ended:
            before = whole_lines(runs)
            _finish(bench, runs)
            check_prefix(bench, runs, before)
        compare(bench, runs, expected)
    return kills


def _kill_once(bench: Bench, runs: Path, after: float) -> Kill | None:
    """Start, kill after so many seconds; None when the search ended by itself before."""
    before = whole_lines(runs)
    process = bench.start(runs)
    try:
        code = process.wait(after)
    except subprocess.TimeoutExpired:
        # Stopped first: nothing new is started between the look and the kill.
        os.killpg(process.pid, signal.SIGSTOP)
        alive = below(process.pid)
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        left = outliving(alive)
        if left:
            bench.fault(runs, f"outlived the kill: {', '.join(left.values())}")
        check_prefix(bench, runs, before)
        lines = whole_lines(runs)
        last = json.loads(lines[-1]) if lines else {"event": "nothing"}
        words = f"{last['event']} {last.get('experiment', '')}".strip()
        return Kill(runs.name, after, len(lines), words, len(alive), len(left))
    if code != 0:
        bench.fault(runs, f"ended with exit code {code}: see {runs.name}.log")
    check_prefix(bench, runs, before)
    return None


def _kill_starts(count: int, random: np.random.Generator) -> int:
    """Kill processes that start workers; 1 when a process outlives its kill."""
    mark = f"kill-{secrets.token_hex(8)}"
    for after in random.uniform(0.0, LONGEST_START_SECONDS, size=count):
        _kill_start(mark, float(after))
    left = _bearing(mark)
    end = time.monotonic() + DIE_SECONDS
    while left and time.monotonic() < end:
        time.sleep(0.05)
        left = _bearing(mark)
    for pid in left:
        os.kill(pid, signal.SIGKILL)
    print(f"{count} kills of processes that start workers: {len(left)} processes left")
    return 1 if left else 0


def _kill_start(mark: str, after: float) -> None:
    read, write = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            # The first word of bubblewrap's command line, by which its halves are found again.
            orphans.secrets.token_hex = lambda nbytes=None: mark
            os.write(write, b"x")
            while True:
                open_worker(Isolation.NAMESPACE, Limits(10.0, 10.0, 1024)).close()
        finally:
            os._exit(1)
    os.read(read, 1)
    for fd in (read, write):
        os.close(fd)
    time.sleep(after)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)


def _bearing(mark: str) -> list[int]:
    return [pid for pid, (_, _, line) in processes().items() if mark in line]


def _finish(bench: Bench, runs: Path) -> None:
    code = bench.start(runs).wait()
    if code != 0:
        sys.exit(f"asia ended with exit code {code}: see {bench.out / runs.name}.log")


if __name__ == "__main__":
    sys.exit(main())
