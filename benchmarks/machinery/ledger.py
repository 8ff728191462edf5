"""How long a very long search takes to check, to ask about and to resume.

python benchmarks/machinery/ledger.py [--experiments 100000] [--folds 2] [--files] [--out DIR]

Writes a ledger of made-up experiments, through the package's own encoder, and measures `verify`,
`asia status` (as a command, first with no index and then with one) and what resuming does before
its first experiment. Without --files all experiments name the same few artifacts; with it each
has a source and three artifacts a fold of its own, as a search leaves them. Prints one row a
measurement: seconds, best of --repeats, and processor seconds of the same.
"""

from __future__ import annotations

import argparse
import hashlib
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from asia.errors import Reason
from asia.judge.scoring.outcome import Failure, FoldRecord, Score
from asia.judge.scoring.residuals import Diagnostics
from asia.ledger.chain import BEGIN, Chain, encode
from asia.ledger.events import Evaluated, Event, Proposed, ReferenceScored, Started
from asia.ledger.index import index_path
from asia.ledger.verification import verify

ASIA = str(Path(sys.executable).parent / "asia")
NAME = "long"
LOCK = b"made up\n"
HYPOTHESIS = "A second state and a saturating input should remove the slow part of the residual."


def main() -> None:
    """Write, measure, print."""
    options = _options()
    runs = Path(options.out or tempfile.mkdtemp(prefix="asia-ledger-"))
    directory = runs / NAME
    files = _Files(directory / "artifacts", options.files)
    begin = time.monotonic()
    size = _write(directory, options.experiments, options.folds, files)
    print(
        f"{options.experiments} experiments of {options.folds} folds, {size / 1e6:.0f} MB, "
        f"{files.count} artifacts, written in {time.monotonic() - begin:.0f} s"
    )
    index = index_path(directory)
    status = [ASIA, "status", NAME, "--runs", str(runs)]
    print(f"{'':<28}{'seconds':>9}{'processor':>11}")
    _measure("verify", lambda: verify(directory), options.repeats)
    _measure("status, no index yet", lambda: (index.unlink(missing_ok=True), _run(status)), 1)
    _measure("status", lambda: _run(status), options.repeats)
    _measure("resume: open and replay", lambda: _resume(directory), options.repeats)
    if options.out is None:
        shutil.rmtree(runs)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--experiments", type=int, default=100_000)
    parser.add_argument("--folds", type=int, default=2)
    parser.add_argument("--files", action="store_true", help="artifacts of its own for each")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--out", help="an empty directory to keep; default: a temporary one")
    return parser.parse_args()


def _measure(what: str, job: Callable[[], object], repeats: int) -> None:
    times: list[tuple[float, float]] = []
    for _ in range(repeats):
        begin, used = time.monotonic(), _processor()
        job()
        times.append((time.monotonic() - begin, _processor() - used))
    wall, used = min(t[0] for t in times), min(t[1] for t in times)
    print(f"{what:<28}{wall:>9.2f}{used:>11.2f}", flush=True)


def _processor() -> float:
    who = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    found = [resource.getrusage(w) for w in who]
    return sum(f.ru_utime + f.ru_stime for f in found)


def _run(command: list[str]) -> None:
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)


def _resume(directory: Path) -> None:
    with Chain(directory / "ledger.jsonl") as chain:
        assert chain.view.started.run == NAME


class _Files:
    """Artifacts: all different, or always the same one."""

    def __init__(self, directory: Path, different: bool) -> None:
        directory.mkdir(parents=True)
        self._directory = directory
        self._different = different
        self.count = 0

    def put(self, data: bytes) -> str:
        """Unsynced: what is measured reads them."""
        data = data + str(self.count).encode() if self._different else b"the same"
        digest = hashlib.sha256(data).hexdigest()
        if self._different or self.count == 0:
            (self._directory / digest).write_bytes(data)
            self.count += 1
        return digest


def _write(directory: Path, experiments: int, folds: int, files: _Files) -> int:
    random = np.random.default_rng(0)
    (directory / "problem.lock.toml").write_bytes(LOCK)
    place = BEGIN
    with (directory / "ledger.jsonl").open("wb") as stream:
        for event in _events(experiments, folds, files, random):
            raw = encode(place, event)
            stream.write(raw)
            place = place.behind(raw)
    return place.offset


def _events(
    experiments: int, folds: int, files: _Files, random: np.random.Generator
) -> Iterator[Event]:
    yield Started(
        run=NAME, problem="made_up", agent="random", seed=0, experiments=experiments + 1,
        hours=None, outputs=("y",), lock_digest=hashlib.sha256(LOCK).hexdigest(),
        protocol_digest="1" * 64, test_digest=None, isolation="namespace", isolation_notes=(),
        environment={},
    )  # fmt: skip
    yield ReferenceScored("linear model", _score(random, folds))
    best = np.inf
    for number in range(1, experiments + 1):
        source = files.put(HYPOTHESIS.encode() * 20)
        yield Proposed(
            number, number - 1 or None, "refine", "narx", f"polynomial of order {number % 7}",
            HYPOTHESIS, "A lower V.", source, hashlib.sha256(str(number).encode()).hexdigest(),
        )  # fmt: skip
        if number % 20 == 0:
            failure = Failure(Reason.CRASH, "Traceback\nValueError: " + "x" * 200, 1)
            yield Evaluated(number, "crash", failure, None, 1.0, isolation="namespace")
            continue
        outcome = _score(random, folds, files)
        status = "keep" if outcome.value < best else "discard"
        best = min(best, outcome.value)
        yield Evaluated(number, status, outcome, None, 1.0, isolation="namespace")


def _score(random: np.random.Generator, folds: int, files: _Files | None = None) -> Score:
    """files: where a fitted candidate keeps its artifacts."""
    values = random.uniform(0.1, 1.0, folds)
    scores = [FoldRecord(v, (v,), (v,), (1 - v,), (0.9,)) for v in values.tolist()]
    if files is not None:
        scores = [_fitted(one, files, random) for one in scores]
    return Score(float(values.mean()), tuple(scores))


def _fitted(score: FoldRecord, files: _Files, random: np.random.Generator) -> FoldRecord:
    model, y_hat, curve = (files.put(random.bytes(n)) for n in (1500, 4000, 800))
    return replace(
        score, model=model, y_hat=y_hat, curve=curve, fit_seconds=float(random.uniform()),
        diagnostics=Diagnostics(*random.uniform(size=8).tolist()),
    )  # fmt: skip


if __name__ == "__main__":
    main()
