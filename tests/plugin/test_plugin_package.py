"""The example package, installed into a fresh environment, as a person would use it."""

from __future__ import annotations

import json
import os
import shutil
import site
import subprocess
import sys
from pathlib import Path

import pytest

from asia.ledger.run import open_run

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "examples" / "plugin"
SUITES = """
from pathlib import Path

from asia.data import Signal
from asia.data.sources import Channels, DataTable
from asia.testing import (
    check_agent, check_export_target, check_family, check_metric, check_source,
    check_validation_check,
)
from asia_example.agent import Doubling
from asia_example.card import CARD
from asia_example.check import check_offset
from asia_example.metric import P95
from asia_example.source import Tables
from asia_example.target import JsonTarget

check_agent(Doubling)
for family in CARD.families:
    check_family(family)
check_metric(P95)
check_export_target(JsonTarget())
check_validation_check(check_offset)
channels = Channels((Signal("power"),), (Signal("temperature"),), 10.0)
table = DataTable(source="tables:records")
check_source(lambda: Tables.from_table(table, Path("oven").resolve()), channels)
"""

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def programs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Programs of an environment of its own, with the libraries of this one and the package."""
    home = tmp_path_factory.mktemp("fresh")
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", home], check=True)
    python = str(home / "bin" / "python")
    library = next((home / "lib").glob("python3*")) / "site-packages"
    for folder in site.getsitepackages():
        shutil.copytree(folder, library, copy_function=linked, dirs_exist_ok=True)
    pip = [sys.executable, "-m", "pip", "--python", python, "install", "--quiet"]
    offline = ["--no-deps", "--no-index", "--no-build-isolation", "--disable-pip-version-check"]
    subprocess.run([*pip, *offline, str(EXAMPLE)], check=True)
    program = home / "bin" / "asia"
    program.write_text(f"#!{python}\nfrom asia.interfaces.cli import main\nmain()\n")
    program.chmod(0o755)
    return program.parent


def linked(source: str, target: str) -> str:
    """A hard link where the file system allows one, else a copy."""
    try:
        os.link(source, target)
    except OSError:
        shutil.copy2(source, target)
    return target


def run(programs: Path, *words: str, cwd: Path) -> str:
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "COV"))}
    done = subprocess.run(
        [programs / words[0], *words[1:]],
        cwd=cwd,
        env=environment,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_doctor_lists_every_part_and_where_it_comes_from(programs: Path, tmp_path: Path) -> None:
    found = json.loads(run(programs, "asia", "doctor", "--json", cwd=tmp_path))
    brought = {(p["kind"], p["name"]) for p in found["parts"] if p["package"] == "asia-example"}
    assert brought == {
        ("families", "fir"),
        ("agents", "doubling"),
        ("sources", "tables"),
        ("metrics", "p95"),
        ("export_targets", "json"),
        ("validation_checks", "offset"),
        ("commands", "taps"),
    }


@pytest.mark.long
def test_every_part_serves_a_search_and_its_test(programs: Path, tmp_path: Path) -> None:
    run(programs, "python", str(EXAMPLE / "make_problem.py"), "oven", cwd=tmp_path)
    words = ("run", "oven", "--agent", "doubling", "--experiments", "3", "--name", "oven")
    printed = run(programs, "asia", *words, cwd=tmp_path)
    assert "finite impulse response of 20 taps" in printed
    assert "95 % error" in printed
    view = open_run(tmp_path / "runs" / "oven").view
    assert [e.proposed.family for e in view.finished if e.score] == ["baseline", "fir", "fir"]
    assert view.started.environment["asia-example"] == "1.0"
    assert "95 % error" in run(programs, "asia", "show", "oven", cwd=tmp_path)
    run(programs, "asia", "verify", "oven", cwd=tmp_path)
    taps = run(programs, "asia", "taps", "runs/oven", cwd=tmp_path).splitlines()
    assert [line.partition(":")[0] for line in taps] == [
        f"finite impulse response of {n} taps" for n in (10, 20)
    ]
    assert "95 % error" in run(programs, "asia", "unseal", "oven", "--yes", cwd=tmp_path)
    run(programs, "asia", "verify", "--replay", "oven", cwd=tmp_path)
    assert "the mean error is at most" in run(programs, "asia", "validate", "oven", cwd=tmp_path)
    exported = run(programs, "asia", "export", "oven", "--to", "json", cwd=tmp_path)
    assert exported.splitlines()[1].startswith("json ")
    assert (tmp_path / "runs" / "oven" / "export" / "json" / "program.json").is_file()


def test_the_parts_pass_the_suites(programs: Path, tmp_path: Path) -> None:
    run(programs, "python", str(EXAMPLE / "make_problem.py"), "oven", cwd=tmp_path)
    run(programs, "python", "-c", SUITES, cwd=tmp_path)
