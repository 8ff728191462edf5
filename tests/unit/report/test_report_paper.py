"""Parts of a paper from a run: figures, tables, and the paragraph on methods."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread

from asia.candidate import ParameterEstimate, ParameterEstimates
from asia.ledger.chain import Chain
from asia.ledger.events import Refitted
from asia.ledger.evidence import put_estimates
from asia.ledger.run import open_run
from asia.problem.load import load_problem
from asia.problem.lock import lock_text
from asia.problem.problem import Seal
from asia.report.files import COLUMN, PAGE, write_figures
from asia.report.paper import latex, methods_paragraph, write_tables

from .made_up import write_run

OUTCOMES = (("50 % more & $x_1$ \\input{secret}", 0.5), ("failing", None), ("last", 0.2))


@pytest.fixture
def run(tmp_path: Path) -> Path:
    directory = tmp_path / "made"
    directory.mkdir()
    lock = lock_text(load_problem("two_tanks_sim"), Seal(None, None))
    (directory / "problem.lock.toml").write_text(lock, "utf-8")
    return write_run(directory, load_problem("two_tanks_sim"), OUTCOMES, unsealed=1)


@pytest.mark.long
def test_figures_are_as_wide_as_a_column_or_a_page(run: Path, tmp_path: Path) -> None:
    paths = write_figures(run, tmp_path / "figures")
    names = {path.stem for path in paths}
    assert {"progress", "simulation", "residuals", "test"} <= names
    assert {path.suffix for path in paths} == {".pdf", ".svg", ".png"}
    for path in paths:
        if path.suffix == ".png":
            width = imread(path).shape[1] / 300
            assert min(abs(width - COLUMN), abs(width - PAGE)) < 0.02, path.name


def test_tables_have_every_experiment_and_no_command_of_a_candidate(
    run: Path, tmp_path: Path
) -> None:
    paths = {path.name: path.read_text("utf-8") for path in write_tables(run, tmp_path / "tables")}
    assert set(paths) == {"experiments.tex", "best.tex", "test.tex"}
    table = paths["experiments.tex"]
    assert r"\input" not in table
    assert r"50 \% more \& \$x\_1\$ \textbackslash{}input\{secret\}" in table
    assert r"$-60.0$ \%" in table
    assert r"\#02 & failing & -- & -- & invalid \\" in table
    for text in paths.values():
        rows = [line for line in text.splitlines() if line.endswith(r"\\")]
        columns = {len(re.findall(r"(?<!\\)&", line)) for line in rows}
        assert len(columns) == 1


def test_parameters_have_a_table_where_the_best_candidate_has_some(
    run: Path, tmp_path: Path
) -> None:
    rows = (ParameterEstimate("k_1", 0.25, 0.012, 0.2264, 0.2736, "1/s", 0.001, 1.0),)
    found = ParameterEstimates(rows, np.ones((1, 1)), ())
    name = put_estimates(open_run(run).store, found)
    with Chain(run / "ledger.jsonl") as chain:
        chain.append(Refitted(3, None, "made up", estimates=name))
    paths = {path.name: path for path in write_tables(run, tmp_path / "tables")}
    table = paths["parameters.tex"].read_text("utf-8")
    assert r"k\_1 & 0.25 & 1/s & 0.012 & 0.2264 to 0.2736 & noise \\" in table


def test_every_special_character_is_printed_as_it_is() -> None:
    assert latex("a_b^c~{d}") == r"a\_b\textasciicircum{}c\textasciitilde{}\{d\}"


def test_the_paragraph_names_what_a_reader_has_to_know(run: Path) -> None:
    words = methods_paragraph(run)
    view = open_run(run).view
    assert view.unsealed is not None
    for part in (
        "It evaluated 3 candidates, of which 1 gave no score",
        "cross-validation over 2 folds",
        "linear model 0.3450",
        "isolation level namespace",
        "V = 0.2000",
        "Sealed test: opened by this run once, after the search; SHA-256 ",
        view.started.lock_digest[:16],
    ):
        assert part in words
    assert "\n" not in words


def test_a_sealed_run_has_no_figure_of_the_test(tmp_path: Path) -> None:
    directory = tmp_path / "sealed"
    directory.mkdir()
    problem = load_problem("two_tanks_sim")
    (directory / "problem.lock.toml").write_text(lock_text(problem, Seal(None, None)), "utf-8")
    write_run(directory, problem, OUTCOMES)
    assert "Sealed test: never opened; SHA-256 " in methods_paragraph(directory)
    assert "test.tex" not in {p.name for p in write_tables(directory, tmp_path / "tables")}
