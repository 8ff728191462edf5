"""Fuzz the parsers with atheris (https://github.com/google/atheris), guided by coverage.

    pip install atheris
    python fuzz/run.py csv --seconds 600      # one parser
    python fuzz/run.py --all --seconds 600    # each in turn, in a process of its own
    python fuzz/run.py --list

Ends with 1 when an input raised what its parser does not promise, or took longer than 20 s; the
input is then in fuzz/found/PARSER-*, and tests/unit/fuzz run it from there on.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import time
from pathlib import Path

HERE = Path(__file__).resolve().parent
LIMITS = ("-timeout=20", "-rss_limit_mb=4096", "-max_len=4096", "-print_final_stats=1")


def main() -> int:
    """Exit code."""
    words = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    words.add_argument("parser", nargs="*")
    words.add_argument("--all", action="store_true")
    words.add_argument("--list", action="store_true")
    words.add_argument("--seconds", type=int, default=600)
    words.add_argument("--inside", help=argparse.SUPPRESS)
    given = words.parse_args()
    sys.path.insert(0, str(HERE.parent))
    if given.inside:
        return _fuzz(given.parser[0], Path(given.inside), given.seconds)
    from fuzz.targets import NAMES, temporary_folder

    if given.list:
        print("\n".join(NAMES))
        return 0
    wanted = NAMES if given.all else given.parser
    unknown = [name for name in wanted if name not in NAMES]
    if unknown or not wanted:
        words.error(f"expected parsers of: {', '.join(NAMES)}")
    print(f"{'parser':<12} {'seconds':>8} {'inputs':>10} {'corpus':>7}  result", flush=True)
    worst = 0
    for name in wanted:
        with temporary_folder(name) as folder:
            worst = max(worst, _one(name, given.seconds, Path(folder)))
    return worst


def _one(name: str, seconds: int, folder: Path) -> int:
    """Fuzz in a process of its own, print a line of the table."""
    (folder / "corpus").mkdir()
    start = time.monotonic()
    words = [name, "--seconds", str(seconds), "--inside", str(folder)]
    inner = [sys.executable, __file__, *words]
    done = subprocess.run(inner, capture_output=True, text=True, errors="replace", check=False)
    took = time.monotonic() - start
    kept = len(os.listdir(folder / "corpus"))
    said = done.stdout + done.stderr
    executed = re.search(r"number_of_executed_units: *(\d+)", said)
    result = "nothing found" if done.returncode == 0 else "FOUND, see below"
    inputs = executed[1] if executed else "?"
    print(f"{name:<12} {took:>8.0f} {inputs:>10} {kept:>7}  {result}", flush=True)
    if done.returncode:
        print("\n".join(said.splitlines()[-60:]), file=sys.stderr)
    return int(done.returncode != 0)


def _fuzz(name: str, folder: Path, seconds: int) -> int:
    import atheris

    with atheris.instrument_imports(include=["asia", "tomllib", "json", "csv"]):
        from fuzz.targets import Place, make_targets
    target = make_targets(Place(folder / "place"))[name]
    corpus = folder / "corpus"
    for number, seed in enumerate(target.seeds):
        (corpus / f"seed{number}").write_bytes(seed)
    found = HERE / "found"
    found.mkdir(exist_ok=True)
    options = [*LIMITS, f"-max_total_time={seconds}", f"-artifact_prefix={found}/{name}-"]
    atheris.Setup([sys.argv[0], *options, str(corpus)], target)
    atheris.Fuzz()
    return 0


if __name__ == "__main__":
    sys.exit(main())
