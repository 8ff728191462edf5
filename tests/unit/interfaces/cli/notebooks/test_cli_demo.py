"""asia demo: the example notebooks are listed, copied and run."""

from __future__ import annotations

from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

from tests.unit.interfaces.cli.conftest import Asia

FOLDER = Path(__file__).parents[5] / "examples/notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))


def test_it_lists_every_notebook_by_its_title(asia: Asia) -> None:
    lines = asia("demo").out.splitlines()
    assert [line.split()[0] for line in lines[:-1]] == [path.stem for path in NOTEBOOKS]
    assert "Your equations as a grey box" in "\n".join(lines)


def test_it_copies_one_and_overwrites_nothing(asia: Asia, tmp_path: Path) -> None:
    done = asia("demo", "own_csv", "--out", tmp_path)
    assert done.code == 0
    assert (tmp_path / "own_csv.ipynb").read_bytes() == (FOLDER / "own_csv.ipynb").read_bytes()
    again = asia("demo", "own_csv", "--out", tmp_path)
    assert again.code == 2
    assert "exists: give another --out" in again.err
    assert "did you mean" in asia("demo", "own_cvs").err
    assert asia("demo", "own_csv", "--out", tmp_path / "none").code == 2


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_it_is_saved_with_its_outputs(path: Path) -> None:
    cells = nbformat.read(path, as_version=4).cells
    assert all(cell.execution_count for cell in cells if cell.cell_type == "code")
    outputs = [output for cell in cells for output in cell.get("outputs", ())]
    assert outputs
    assert not any(output.output_type == "error" for output in outputs)
    assert path.stat().st_size < 400_000


@pytest.mark.long
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_it_runs(path: Path, tmp_path: Path) -> None:
    notebook = nbformat.read(path, as_version=4)
    place = {"metadata": {"path": str(tmp_path)}}
    NotebookClient(notebook, timeout=1200, kernel_name="python3", resources=place).execute()
