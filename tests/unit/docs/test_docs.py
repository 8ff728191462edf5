"""The documents' commands run, and their tables say what the code knows."""

import os
import re
import shlex
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from asia.data import Signal, Trajectory, sources
from asia.problem import Budget
from asia.problem.physics import FUNCTIONS
from asia.problem.protocol import ProtocolRule
from asia.testing import check_source

ROOT = Path(__file__).parents[3]
README = (ROOT / "README.md").read_text()


def blocks(text: str) -> list[list[str]]:
    """Commands of each sh block, comments cut."""
    found = re.findall(r"```sh\n(.*?)```", text, flags=re.DOTALL)
    return [[line.split("#")[0].strip() for line in b.splitlines() if line.strip()] for b in found]


def run(command: str, directory: Path) -> str:
    environment = {**os.environ, "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
    done = subprocess.run(
        shlex.split(command), cwd=directory, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, f"{command}: {done.stderr}"
    return done.stdout


@pytest.fixture
def records(tmp_path: Path) -> Path:
    rng = np.random.default_rng(0)
    for name in ("run1", "run2", "run3"):
        u = rng.normal(size=150)
        y = np.convolve(u, 0.8 ** np.arange(20))[:150] + 0.05 * rng.normal(size=150)
        table = np.stack([0.1 * np.arange(150), u, y], axis=1)
        np.savetxt(tmp_path / f"{name}.csv", table, delimiter=",", header="time,u,y", comments="")
    return tmp_path


@pytest.mark.slow
def test_the_commands_for_ones_own_records_run_as_written(records: Path) -> None:
    commands = next(b for b in blocks(README) if b[0].startswith("asia init"))
    for command in commands:
        output = run(command.replace("--experiments 10", "--experiments 1"), records)
        if command == "asia status":
            assert "1 of 1 experiments" in output
    assert (records / "runs" / "mill-expert-s0" / "report" / "test.png").is_file()


def test_every_command_in_the_readme_exists(tmp_path: Path) -> None:
    words = {c.split()[1] for b in blocks(README) for c in b if c.startswith("asia ")}
    assert words == {"run", "show", "unseal", "init", "check", "status", "report"}
    for word in sorted(words):
        assert word in run(f"asia {word} --help", tmp_path)


def test_the_problem_page_names_the_defaults() -> None:
    page = (ROOT / "docs" / "problem.md").read_text()
    for key, value in (
        ("budget.experiments", Budget().experiments),
        ("budget.fit_seconds", f"{Budget().fit_seconds:g}"),
        ("budget.memory_mb", Budget().memory_mb),
        ("budget.patience", Budget().patience),
        ("protocol.past_inputs`, `past_outputs", f"{ProtocolRule().past_inputs}, 10"),
    ):
        assert f"| `{key}` | {value} |" in page
    for name in FUNCTIONS:
        assert re.search(rf"\b{name}\b", page), f"{name} is not documented"


def test_the_source_of_the_page_on_parts_conforms(tmp_path: Path) -> None:
    page = (ROOT / "docs" / "extending.md").read_text()
    blocks = re.findall(r"```python\n(.*?)```", page, flags=re.DOTALL)
    names = {name: getattr(sources, name) for name in ("DataSet", "SourceData")}
    made = {**names, "dataclass": dataclass, "np": np, "Path": Path, "Trajectory": Trajectory}
    made["__name__"] = __name__  # where dataclasses look names up
    exec(next(block for block in blocks if "class Loggers" in block), made)
    for number, name in enumerate(("train1", "train2", "test1")):
        records = np.random.default_rng(number).normal(size=(90, 2))
        np.save(tmp_path / f"{name}.npy", records)
    table = sources.DataTable(source=f"loggers:{tmp_path.name}")
    source = made["Loggers"].from_table(table, tmp_path.parent)
    check_source(lambda: source, sources.Channels((Signal("u"),), (Signal("y"),), 0.5))


def test_every_benchmark_is_listed() -> None:
    page = (ROOT / "benchmarks" / "README.md").read_text()
    scripts = sorted((ROOT / "benchmarks").rglob("*.py"))
    assert len(scripts) > 10
    for script in scripts:
        name = script.relative_to(ROOT / "benchmarks").as_posix()
        assert f"`{name}`" in page, f"{name} is not listed"
