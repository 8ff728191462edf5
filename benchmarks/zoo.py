"""Searches on ten measured systems: V, test error, seconds and the families that were tried.

A row of the table is one system searched by one installation. The test error is the root mean
square over all outputs and samples, each output in units of its standard deviation in the test
record. The number that ASIA prints, in units of the output, stands in brackets. Processor seconds
are those that the system reports for child processes: compare them only between searches with the
same isolation, because those inside a namespace are not all reported. Finished searches are not
repeated: the same command resumes. `--asia` may name several installations, the older one first,
each with an agent of its own (`forward=.venv/bin/asia@forward`). The last lines count the
experiments whose V is above that of the linear model.
With `--read` no search is started.

    python benchmarks/zoo.py --zoo DATA/zoo --runs runs-zoo --asia now=.venv/bin/asia
"""

from __future__ import annotations

import argparse
import csv
import json
import math
import os
import resource
import shutil
import subprocess
import sys
import time
import tomllib
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean, geometric_mean, pstdev
from typing import Any

SYSTEMS = (
    "hairdryer", "heating", "dryer2", "thermic_wall", "ph", "cd_arm", "winding", "evaporator",
    "cstr", "steamgen",
)  # fmt: skip


def children_seconds() -> float:
    """Processor seconds of all child processes that have ended."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def search(asia: str, problem: Path, runs: Path, experiments: int) -> dict[str, Any]:
    """Search `problem`, open its test, and return the figures of the run."""
    result = runs / f"{problem.name}.json"
    if result.is_file():
        return json.loads(result.read_text("utf-8"))
    env = {**os.environ, "ASIA_RUNS": str(runs)}
    log = (runs / f"{problem.name}.log").open("w", encoding="utf-8")
    start, used = time.monotonic(), children_seconds()
    asia, _, agent = asia.partition("@")
    command = [asia, "run", str(problem), "--experiments", str(experiments), "--name", problem.name]
    command += ["--agent", agent] if agent else []
    code = subprocess.run(command, env=env, stdout=log, stderr=log, check=False).returncode
    wall, processor = time.monotonic() - start, children_seconds() - used
    unseal = [asia, "unseal", str(runs / problem.name), "--yes"]
    subprocess.run(unseal, env=env, stdout=log, stderr=log, check=False)
    ask = [asia, "status", str(runs / problem.name), "--json"]
    status = subprocess.run(ask, env=env, capture_output=True, text=True, check=False)
    lines = [json.loads(line) for line in status.stdout.splitlines() if line.startswith("{")]
    found = {
        "code": code,
        "wall": wall,
        "processor": processor,
        "status": lines[-1] if lines else {},
    }
    found["events"] = [
        json.loads(line)
        for line in (runs / problem.name / "ledger.jsonl").read_text("utf-8").splitlines()
    ]
    result.write_text(json.dumps(found), encoding="utf-8")
    return found


def output_scales(problem: Path) -> dict[str, float]:
    """Standard deviation of each output over the test records."""
    declared = tomllib.loads((problem / "problem.toml").read_text("utf-8"))
    rows: list[dict[str, str]] = []
    for name in declared["data"]["test"]:
        with (problem / name).open(encoding="utf-8", newline="") as file:
            rows += csv.DictReader(file)
    columns = {o["name"]: [float(row[o["name"]]) for row in rows] for o in declared["outputs"]}
    return {name: pstdev(values) for name, values in columns.items()}


def pooled_errors(
    found: dict[str, Any], scales: dict[str, float]
) -> dict[str, tuple[float, float]]:
    """Pooled error and ASIA's own number, of each model that was tested."""
    opened = [event for event in found["events"] if event["event"] == "unsealed"]
    errors: dict[str, tuple[float, float]] = {}
    for model in ("ensemble", "refit", "stack") if opened else ():
        scores = (opened[-1].get(model) or {}).get("scores")
        if scores:
            parts = zip(opened[-1]["channels"], scores[0]["per_channel"], strict=True)
            pooled = math.sqrt(fmean((error / scales[name]) ** 2 for name, error in parts))
            errors[model] = pooled, scores[0]["value"]
    return errors


def families_tried(found: dict[str, Any]) -> str:
    """`nl_lfr 5, linear 2`: experiments with each family, the baseline left out."""
    names = [e["family"] for e in found["events"] if e["event"] == "proposed"]
    counted = Counter(name for name in names if name != "baseline")
    return ", ".join(f"{name} {count}" for name, count in counted.most_common())


@dataclass(frozen=True)
class Row:
    """One search in figures; `errors` by model, of which `use` is the one that ASIA names."""

    version: str
    value: float | None
    use: str
    errors: dict[str, tuple[float, float]]
    wall: float
    processor: float
    families: str

    @staticmethod
    def of(version: str, found: dict[str, Any], scales: dict[str, float]) -> Row:
        """Read what `search` stored."""
        status = found["status"]
        best = status.get("best") or {}
        return Row(
            version,
            best.get("V"),
            status.get("use") or "",
            pooled_errors(found, scales),
            found["wall"],
            found["processor"],
            families_tried(found),
        )

    @property
    def test(self) -> float | None:
        """Pooled error of the model to use."""
        return self.errors[self.use][0] if self.use in self.errors else None

    def line(self, system: str, first: Row) -> str:
        """Row of the table; the ratios are to `first`, the row of the first installation."""

        def error(model: str) -> str:
            return "{:.4f} ({:.4g})".format(*self.errors[model]) if model in self.errors else "-"

        value = "-" if self.value is None else f"{self.value:.4f}"
        cells = [
            system, self.version, value, f"{error(self.use)} {self.use}", error("ensemble"),
            error("refit"), f"{self.wall:.0f}", f"{self.processor:.0f}", self.families,
            *(_ratio(self, first, name) for name in RATIOS),
        ]  # fmt: skip
        return f"| {' | '.join(cells)} |"


RATIOS = ("value", "test", "wall", "processor")


def _ratio(row: Row, first: Row, name: str) -> str:
    ours, theirs = getattr(row, name), getattr(first, name)
    return f"{ours / theirs:.2f}" if ours and theirs and row is not first else "-"


def print_lost(found: dict[str, list[dict[str, Any]]]) -> None:
    """For each version the experiments after the baseline whose V is above the linear model's.

    Args:
        found: events of the searches of each version
    """
    print()
    for version, searches in found.items():
        ratios: list[float] = []
        for events in searches:
            linear = next(
                e["outcome"]["value"] for e in events
                if e["event"] in ("reference", "rung") and e["name"] == "linear model"
            )  # fmt: skip
            outcomes = [e["outcome"] for e in events if e["event"] == "evaluated"][1:]
            ratios += [o["value"] / linear for o in outcomes if "value" in o]
        worse = sum(ratio > 1.001 for ratio in ratios), sum(ratio > 1.2 for ratio in ratios)
        print(
            f"{version}: {worse[0]} of {len(ratios)} experiments worse than the linear model, "
            f"{worse[1]} by more than 1.2, the worst {max(ratios, default=1.0):.3g} times"
        )


def print_means(rows: dict[str, dict[str, Row]], versions: list[str]) -> None:
    """Geometric means over the systems that all installations have searched."""
    common = [found for found in rows.values() if len(found) == len(versions)]
    if not common:
        return
    print(f"\nGeometric means over {len(common)} systems:\n")
    print("| version | V | test | seconds | CPU s | V ratio | test ratio | seconds | CPU s |")
    print("|---|---|---|---|---|---|---|---|---|")
    usable = [f for f in common if all(row.value and row.test for row in f.values())]
    for version in versions if usable else ():
        means = [geometric_mean([getattr(f[version], name) for f in usable]) for name in RATIOS]
        firsts = [geometric_mean([getattr(f[versions[0]], n) for f in usable]) for n in RATIOS]
        figures = [f"{mean:.4f}" for mean in means[:2]] + [f"{mean:.0f}" for mean in means[2:]]
        ratios = [f"{mean / first:.2f}" for mean, first in zip(means, firsts, strict=True)]
        print(f"| {version} | {' | '.join((*figures, *ratios))} |")


def main() -> None:
    """Run the searches that are not there yet and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--zoo", type=Path, required=True, help="folder of problem directories")
    parser.add_argument("--systems", nargs="+", default=list(SYSTEMS))
    parser.add_argument("--experiments", type=int, default=8)
    parser.add_argument("--runs", type=Path, default=Path("runs-zoo"))
    parser.add_argument(
        "--asia", nargs="+", default=[f"now={Path(sys.executable).with_name('asia')}"]
    )
    parser.add_argument("--read", action="store_true", help="only read the searches that are there")
    options = parser.parse_args()
    installed = dict(entry.split("=", 1) for entry in options.asia)
    print(
        "| system | version | V | test, model to use | ensemble | refit | seconds | CPU s "
        "| families | V ratio | test ratio | seconds ratio | CPU ratio |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|---|---|---|")
    rows: dict[str, dict[str, Row]] = {}
    events: dict[str, list[dict[str, Any]]] = {}
    for name in options.systems:
        scales = output_scales(options.zoo / name)
        for version, asia in installed.items():
            runs = (options.runs / version).absolute()
            problem = runs / "problems" / name
            if options.read and not (runs / f"{name}.json").is_file():
                continue
            if not problem.is_dir():
                shutil.copytree(options.zoo / name, problem, copy_function=shutil.copyfile)
            found = search(asia, problem, runs, options.experiments)
            row = Row.of(version, found, scales)
            events.setdefault(version, []).append(found["events"])
            known = rows.setdefault(name, {})
            known[version] = row
            print(row.line(name, known.get(next(iter(installed)), row)), flush=True)
    print_means(rows, list(installed))
    print_lost(events)


if __name__ == "__main__":
    main()
