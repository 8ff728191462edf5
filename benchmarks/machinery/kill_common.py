"""Code of both `kill.py` and `kill_cluster.py`: a search as a process, and checks of its files."""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from kill_cheap import NAME, arx

UNDISTURBED = "undisturbed"
ASIA = str(Path(sys.executable).parent / "asia")
ENVELOPE = ("seq", "prev", "self", "time")
CLOCKS = ("seconds", "fit_seconds", "spent", "elapsed")
MEASURED = ("memory_mb", "compile_seconds")
MACHINE = ("machine", "isolation")
SAMPLES = {"train": 240, "test": 120}
DIE_SECONDS = 5.0


@dataclass
class Bench:
    """Settings of all searches, and the errors found."""

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


def check_prefix(bench: Bench, runs: Path, before: list[bytes]) -> None:
    """Check that the earlier records are unchanged, byte by byte: nothing was redone."""
    if whole_lines(runs)[: len(before)] != before:
        bench.fault(runs, "records that were on disk at a kill have changed")


def compare(bench: Bench, runs: Path, expected: list[dict[str, Any]]) -> None:
    """Note every difference between a search at its end and the undisturbed one."""
    found = events(runs)
    if len(found) != len(expected):
        bench.fault(runs, f"{len(found)} records, {len(expected)} undisturbed")
    for number, (a, b) in enumerate(zip(found, expected, strict=False)):
        for key in sorted({*a, *b}):
            if a.get(key) != b.get(key):
                bench.fault(runs, f"record {number} ({b.get('event')}): {key} differs")
    for kind in ("proposed", "landed", "evaluated"):
        counts = Counter(e["experiment"] for e in _records(runs) if e["event"] == kind)
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
    found, expected = ({_unmeasured(p) for p in (d / "artifacts").iterdir()} for d in (here, there))
    for name in sorted(found ^ expected):
        bench.fault(runs, f"artifact {name} is {'too much' if name in found else 'missing'}")


def _without_seconds(path: Path) -> list[list[str]]:
    """The cells of its lines, but those that were measured."""
    rows = [line.split("\t") for line in path.read_text().splitlines()]
    measured = {i for i, name in enumerate(rows[0]) if name == "seconds"}
    return [[cell for i, cell in enumerate(row) if i not in measured] for row in rows]


def _unmeasured(artifact: Path) -> str:
    """Its name; for the findings of a fold that of the same without what was measured."""
    raw = artifact.read_bytes()
    if not raw.startswith(b'{"errors"'):
        return artifact.name
    kept = {k: v for k, v in json.loads(raw).items() if k not in MEASURED}
    return hashlib.sha256(json.dumps(kept, sort_keys=True).encode()).hexdigest()


def whole_lines(runs: Path) -> list[bytes]:
    """The lines of the ledger that are on disk."""
    path = runs / NAME / "ledger.jsonl"
    if not path.is_file():
        return []
    return [line for line in path.read_bytes().splitlines(keepends=True) if line.endswith(b"\n")]


def events(runs: Path) -> list[dict[str, Any]]:
    """Every record without its envelope, measured time, the machine that fitted a fold and what a
    run draws for itself. First fits that landed before their turn are left out: when they land
    depends on the machine."""
    bodies = [body for body in _records(runs) if body["event"] != "landed"]
    for body in bodies:
        body.pop("salt", None)
        # The salt chooses it.
        (body.get("again") or {}).pop("fold", None)
        for fold in body["folds"] if body["event"] == "evaluated" else ():
            for key in MACHINE:
                fold.pop(key, None)
            fold["findings"] = _unmeasured(runs / NAME / "artifacts" / fold["findings"])
    return [_timeless({k: v for k, v in b.items() if k not in ENVELOPE}) for b in bodies]


def _records(runs: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in whole_lines(runs)]


def _timeless(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _timeless(v) for k, v in value.items() if k not in CLOCKS}
    if isinstance(value, list):
        return [_timeless(v) for v in value]
    return value


def processes() -> dict[int, tuple[int, str, str]]:
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


def below(root: int) -> dict[tuple[int, str], str]:
    """The process and all below it: (pid, moment of birth) -> command line."""
    found = processes()
    wanted, grown = {root}, True
    while grown:
        more = {pid for pid, (parent, _, _) in found.items() if parent in wanted} - wanted
        wanted |= more
        grown = bool(more)
    return {(pid, found[pid][1]): found[pid][2] for pid in wanted if pid in found}


def outliving(alive: dict[tuple[int, str], str]) -> dict[tuple[int, str], str]:
    """Those still there after a moment of grace."""
    end = time.monotonic() + DIE_SECONDS
    while True:
        now = {(pid, born) for pid, (_, born, _) in processes().items()}
        left = {key: line for key, line in alive.items() if key in now}
        if not left or time.monotonic() > end:
            return left
        time.sleep(0.05)


def write_problem(directory: Path) -> Path:
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
