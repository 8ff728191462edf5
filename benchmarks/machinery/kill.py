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
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from asia.sandbox import Isolation, Limits, open_worker
from asia.sandbox.worker import orphans
from kill_cheap import NAME, arx

CHEAP = "cheap"
UNDISTURBED = "undisturbed"
ASIA = str(Path(sys.executable).parent / "asia")
ENVELOPE = ("seq", "prev", "self", "time")
CLOCKS = ("seconds", "fit_seconds", "spent")
SAMPLES = {"train": 240, "test": 120}
DIE_SECONDS = 5.0
# Kills fall into this share of an undisturbed search, so that most searches meet several.
SHARE = 0.6
LONGEST_START_SECONDS = 0.03


@dataclass
class Bench:
    """What all searches share, and what went wrong."""

    command: tuple[str, ...]
    out: Path
    random: np.random.Generator
    faults: list[str] = field(default_factory=list)

    def start(self, runs: Path) -> subprocess.Popen[bytes]:
        """The search in a session of its own."""
        log = (self.out / f"{runs.name}.log").open("ab")
        with log:
            return subprocess.Popen(
                [*self.command, "--runs", str(runs)],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                start_new_session=True,
            )

    def fault(self, runs: Path, words: str) -> None:
        """Note what must not be."""
        self.faults.append(f"{runs.name}: {words}")


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
    problem = _write_problem(out / "problem")
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
    expected = _events(reference)
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
            before = _whole_lines(runs)
            _finish(bench, runs)
            _check_prefix(bench, runs, before)
        _compare(bench, runs, expected)
    return kills


def _kill_once(bench: Bench, runs: Path, after: float) -> Kill | None:
    """Start, kill after so many seconds; None when the search ended by itself before."""
    before = _whole_lines(runs)
    process = bench.start(runs)
    try:
        code = process.wait(after)
    except subprocess.TimeoutExpired:
        # Stopped first: nothing new is started between the look and the kill.
        os.killpg(process.pid, signal.SIGSTOP)
        alive = _below(process.pid)
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        left = _outliving(alive)
        if left:
            bench.fault(runs, f"outlived the kill: {', '.join(left.values())}")
        _check_prefix(bench, runs, before)
        lines = _whole_lines(runs)
        last = json.loads(lines[-1]) if lines else {"event": "nothing"}
        words = f"{last['event']} {last.get('experiment', '')}".strip()
        return Kill(runs.name, after, len(lines), words, len(alive), len(left))
    if code != 0:
        bench.fault(runs, f"ended with exit code {code}: see {runs.name}.log")
    _check_prefix(bench, runs, before)
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
    return [pid for pid, (_, _, line) in _processes().items() if mark in line]


def _finish(bench: Bench, runs: Path) -> None:
    code = bench.start(runs).wait()
    if code != 0:
        sys.exit(f"asia ended with exit code {code}: see {bench.out / runs.name}.log")


def _check_prefix(bench: Bench, runs: Path, before: list[bytes]) -> None:
    """What was recorded before stands, byte by byte: nothing was redone in its place."""
    if _whole_lines(runs)[: len(before)] != before:
        bench.fault(runs, "records that were on disk at a kill have changed")


def _compare(bench: Bench, runs: Path, expected: list[dict[str, Any]]) -> None:
    found = _events(runs)
    if len(found) != len(expected):
        bench.fault(runs, f"{len(found)} records, {len(expected)} undisturbed")
    for number, (a, b) in enumerate(zip(found, expected, strict=False)):
        for key in sorted({*a, *b}):
            if a.get(key) != b.get(key):
                bench.fault(runs, f"record {number} ({b.get('event')}): {key} differs")
    for kind in ("proposed", "evaluated"):
        counts = Counter(e["experiment"] for e in found if e["event"] == kind)
        for experiment in (n for n, times in counts.items() if times > 1):
            bench.fault(runs, f"experiment {experiment} was {kind} {counts[experiment]} times")
        lost = {e["experiment"] for e in expected if e["event"] == kind} - counts.keys()
        for experiment in sorted(lost):
            bench.fault(runs, f"experiment {experiment} was never {kind}")
    _compare_files(bench, runs)
    verify = subprocess.run(
        [ASIA, "verify", NAME, "--runs", str(runs)], capture_output=True, text=True, check=False
    )
    if verify.returncode != 0:
        bench.fault(runs, f"asia verify: {verify.stderr.strip()}")


def _compare_files(bench: Bench, runs: Path) -> None:
    """Generated files and artifacts: the same bytes as undisturbed, and nothing half written."""
    here, there = (r / NAME for r in (runs, bench.out / UNDISTURBED))
    for name in ("results.tsv", "problem.lock.toml"):
        if _without_seconds(here / name) != _without_seconds(there / name):
            bench.fault(runs, f"{name} differs")
    found, expected = ({p.name for p in (d / "artifacts").iterdir()} for d in (here, there))
    for name in sorted(found ^ expected):
        bench.fault(runs, f"artifact {name} is {'too much' if name in found else 'missing'}")


def _without_seconds(path: Path) -> list[list[str]]:
    """The cells of its lines, but those that were measured."""
    rows = [line.split("\t") for line in path.read_text().splitlines()]
    measured = {i for i, name in enumerate(rows[0]) if name == "seconds"}
    return [[cell for i, cell in enumerate(row) if i not in measured] for row in rows]


def _whole_lines(runs: Path) -> list[bytes]:
    path = runs / NAME / "ledger.jsonl"
    if not path.is_file():
        return []
    return [line for line in path.read_bytes().splitlines(keepends=True) if line.endswith(b"\n")]


def _events(runs: Path) -> list[dict[str, Any]]:
    """Every record without its envelope, measured time and what a run draws for itself."""
    bodies = [json.loads(line) for line in _whole_lines(runs)]
    for body in bodies:
        body.pop("salt", None)
        # The salt chooses it.
        (body.get("again") or {}).pop("fold", None)
    return [_timeless({k: v for k, v in b.items() if k not in ENVELOPE}) for b in bodies]


def _timeless(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _timeless(v) for k, v in value.items() if k not in CLOCKS}
    if isinstance(value, list):
        return [_timeless(v) for v in value]
    return value


def _processes() -> dict[int, tuple[int, str, str]]:
    """Living processes: pid -> parent, moment of birth, command line."""
    found: dict[int, tuple[int, str, str]] = {}
    for path in Path("/proc").glob("[0-9]*"):
        try:
            words = (path / "stat").read_bytes().rpartition(b")")[2].split()
            line = (path / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
        except OSError:
            continue
        if words[0] not in (b"Z", b"X"):
            found[int(path.name)] = int(words[1]), words[19].decode(), line[:80]
    return found


def _below(root: int) -> dict[tuple[int, str], str]:
    """The process and all below it: (pid, moment of birth) -> command line."""
    found = _processes()
    wanted, grown = {root}, True
    while grown:
        more = {pid for pid, (parent, _, _) in found.items() if parent in wanted} - wanted
        wanted |= more
        grown = bool(more)
    return {(pid, found[pid][1]): found[pid][2] for pid in wanted if pid in found}


def _outliving(alive: dict[tuple[int, str], str]) -> dict[tuple[int, str], str]:
    """Those still there after a moment of grace."""
    end = time.monotonic() + DIE_SECONDS
    while True:
        now = {(pid, born) for pid, (_, born, _) in _processes().items()}
        left = {key: line for key, line in alive.items() if key in now}
        if not left or time.monotonic() > end:
            return left
        time.sleep(0.05)


def _write_problem(directory: Path) -> Path:
    """Second-order linear system with a saturating input and a little noise, as CSV files."""
    random = np.random.default_rng(1)
    directory.mkdir(parents=True)
    for name, samples in SAMPLES.items():
        u = random.standard_normal(samples)
        y = np.zeros(samples)
        for k in range(2, samples):
            v = np.tanh(u[k - 2 : k])
            y[k] = 1.2 * y[k - 1] - 0.5 * y[k - 2] + 0.4 * v[1] + 0.2 * v[0]
        table = np.stack([u, y + 0.01 * random.standard_normal(samples)], axis=1)
        np.savetxt(directory / f"{name}.csv", table, delimiter=",", header="u,y", comments="")
    (directory / "problem.toml").write_text(
        'name = "toy"\nsampling_time = 0.1\ninputs = ["u"]\noutputs = ["y"]\n'
        '[data]\ntrain = ["train.csv"]\ntest = ["test.csv"]\n'
        "[protocol]\npast_inputs = 5\npast_outputs = 5\n"
    )
    (directory / "baseline.py").write_text(arx(1, 0, 10.0))
    return directory


if __name__ == "__main__":
    sys.exit(main())
