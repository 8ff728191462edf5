"""The tutorial's commands, code and equations run as they are printed, on a smaller budget."""

import re
from pathlib import Path

import pytest

from tests.unit.docs.test_docs import ROOT, run

pytestmark = pytest.mark.long
PAGE = (ROOT / "docs" / "tutorial.md").read_text()


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", PAGE, flags=re.DOTALL)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which everything up to the last step of the tutorial was done."""
    folder = tmp_path_factory.mktemp("tutorial")
    measure, use = blocks("python")
    smaller = measure.replace("400", "120").replace("300", "80")
    assert smaller != measure
    (folder / "measure.py").write_text(smaller)
    (folder / "use.py").write_text(use)
    for block in blocks("sh"):
        for command in block.splitlines():
            if "--name tank-physics" in command:
                add_equations(folder / "tank" / "problem.toml")
            (folder / "said.txt").write_text(run(shorter(command), folder))
    return folder


def shorter(command: str) -> str:
    return re.sub(r"--experiments \d+", "--experiments 2", command)


def add_equations(problem: Path) -> None:
    text = problem.read_text()
    assert "\n# [physics]" in text
    problem.write_text(text.split("\n# [physics]")[0] + "\n" + blocks("toml")[0])


def scores(folder: Path, name: str) -> list[float]:
    rows = (folder / "runs" / name / "results.tsv").read_text().splitlines()[1:]
    return [float(row.split("\t")[1]) for row in rows]


def test_both_searches_find_a_model_and_equations_help(folder: Path) -> None:
    linear, _ = scores(folder, "tank-expert-s0")
    assert scores(folder, "tank-physics")[-1] < linear / 2


def test_the_pictures_and_the_source_are_there(folder: Path) -> None:
    assert (folder / "runs" / "tank-expert-s0" / "report" / "residuals.png").is_file()
    assert "def fit(" in (folder / "said.txt").read_text()


def test_the_model_is_used_from_python(folder: Path) -> None:
    error = float(run("python use.py", folder).split()[1])
    assert error < 0.05
