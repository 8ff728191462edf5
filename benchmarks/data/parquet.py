"""Memory and time of `asia init` on a large Parquet file.

    python benchmarks/data/parquet.py [--gigabytes 2] [--columns 32] [--out DIR]

A file of random float64 columns is written, a column of time stamps first; its size on disk is
printed. `asia init` then takes one input and one output out of it. Memory is the peak resident set
of that process, less that of the same command on a file of 2 000 rows: what is left is given as a
multiple of the three columns read, and of the file. The lines of progress are counted.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

SHORT, BATCH, STEP = 2_000, 262_144, 0.01
MEGABYTE = 1e6


@dataclass(frozen=True)
class Taken:
    """One run of `asia init`. peak: of resident memory, in bytes; lines: of progress."""

    peak: int
    seconds: float
    lines: int


def main() -> None:
    """Write both files, take them in, print what it cost."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--gigabytes", type=float, default=2.0)
    parser.add_argument("--columns", type=int, default=32)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    rows = round(options.gigabytes * 1e9 / 8 / (options.columns + 1))
    with tempfile.TemporaryDirectory(prefix="asia-parquet-") as scratch:
        out = options.out or Path(scratch)
        out.mkdir(parents=True, exist_ok=True)
        small = _take(_write(out / "small.parquet", SHORT, options.columns), out)
        large = _write(out / "large.parquet", rows, options.columns)
        taken = _take(large, out)
        size, kept = large.stat().st_size, 3 * 8 * rows
    more = taken.peak - small.peak
    print(f"{rows} rows, {options.columns + 1} columns, {size / MEGABYTE:.0f} MB on disk")
    print(f"load {os.getloadavg()[0]:.1f}; {taken.seconds:.0f} s, {taken.lines} lines of progress")
    print(f"memory {taken.peak / MEGABYTE:.0f} MB, of a short file {small.peak / MEGABYTE:.0f} MB")
    print(f"difference: {more / kept:.1f} of the columns read, {more / size:.2f} of the file")


def _write(path: Path, rows: int, columns: int) -> Path:
    rng = np.random.default_rng(0)
    names = ["t", *(f"x{i}" for i in range(columns))]
    schema = pa.schema([(n, pa.float64()) for n in names])
    with pq.ParquetWriter(path, schema, compression="none", use_dictionary=False) as writer:
        for start in range(0, rows, BATCH):
            size = min(BATCH, rows - start)
            cells = [STEP * np.arange(start, start + size), *rng.normal(size=(columns, size))]
            writer.write_batch(pa.record_batch(cells, schema=schema))
    return path


def _take(path: Path, out: Path) -> Taken:
    name = out / f"problem_{path.stem}"
    given = ["init", str(name), "--train", str(path), "--inputs", "x0", "--outputs", "x1"]
    began = time.monotonic()
    asia = str(Path(sys.executable).with_name("asia"))
    done = subprocess.run([asia, *given], capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"asia init failed:\n{done.stdout}\n{done.stderr}")
    said = done.stderr.replace("\r", "\n").splitlines()
    # The largest child so far: the short file comes first.
    peak = 1024 * resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss
    return Taken(peak, time.monotonic() - began, sum("rows" in x for x in said))


if __name__ == "__main__":
    main()
