"""The tutorial runs as it is printed, on a smaller budget, and prints what the page shows."""

import importlib.util
import re
from pathlib import Path

import pytest

from tests.unit.docs.test_docs import ROOT

_spec = importlib.util.spec_from_file_location("tutorial", ROOT / "docs" / "site" / "tutorial.py")
assert _spec is not None
assert _spec.loader is not None
tutorial = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(tutorial)

PAGE = (ROOT / "docs" / "tutorial.md").read_text()
NUMBER = re.compile(r"[-+]?\d[\d,]*\.?\d*(?:e[-+]?\d+)?")


def smaller(text: str) -> str:
    """The tutorial with shorter records and fewer experiments."""
    for old, new in (
        ('"run1", 400), ("run2", 400), ("run3", 300', '"run1", 120), ("run2", 120), ("run3", 80'),
    ):
        assert old in text
        text = text.replace(old, new)
    return re.sub(r"--experiments \d+", "--experiments 2", text)


def shape(line: str) -> str:
    """A line without its numbers, times, digests, titles and texts of candidates."""
    line = re.sub(r"sha256[: ]\w+", "sha256", line)
    line = re.sub(r"\b(\d+h)?(\d+m)?\d+s\b", "TIME", line)
    line = re.sub(r"\s+", " ", NUMBER.sub("N", line.removesuffix(" ..."))).strip()
    line = re.sub(r"^#N \w+ V=N min fit <?N % TIME.*", "#N STATUS", line)
    line = re.sub(r"^#N (?!STATUS).*", "#N TITLE", line)
    line = re.sub(r"^((best #N V=|result V = )N \(folds N(, N)*\)).*", r"\1", line)
    line = re.sub(r"\b(refit|ensemble): .*", "MODEL", line)
    # The page cuts these lines at a width, which the digits of the numbers move.
    line = re.sub(r"^((in|out)put \w+: .{20}).*", r"\1", line)
    line = re.sub(r"\b(noise|folds|missing effect)$", "SOURCE", line)
    return re.sub(r"^(hypothesis|expected|decision|picture) .*", r"\1", line)


def shapes(text: str) -> set[str]:
    return {shape(line) for line in text.splitlines()} - {"...", ""}


def outputs(page: str) -> dict[str, str]:
    return {found["command"]: found["shown"] for found in tutorial.OUTPUT.finditer(page)}


def test_every_output_belongs_to_a_command_and_is_generated() -> None:
    commands = "\n".join(tutorial.blocks(PAGE, "sh")).splitlines()
    assert set(outputs(PAGE)) <= set(commands)
    fences = re.findall(r"^```(.*)$", PAGE, flags=re.MULTILINE)[::2]
    assert len(outputs(PAGE)) == fences.count("") >= 7
    assert all(shown.strip() for shown in outputs(PAGE).values())


def test_figures_in_the_text_are_those_of_the_outputs() -> None:
    """Each number with decimals that the text mentions is in an output, rounded."""
    prose = re.sub(r"^```.*?^```", "", PAGE, flags=re.DOTALL | re.MULTILINE)
    prose = re.sub(r"<!--.*?-->", "", prose, flags=re.DOTALL)
    mentioned = re.findall(r"\d+\.\d+", prose)
    printed = [float(n) for shown in outputs(PAGE).values() for n in re.findall(r"\d+\.\d+", shown)]
    strange = [
        text
        for text in mentioned
        if not any(f"{value:.{len(text.partition('.')[2])}f}" == text for value in printed)
    ]
    assert mentioned
    assert strange == []


def test_outputs_are_shortened_and_put_in_their_places() -> None:
    page = "<!-- output of `asia show`, lines with ^(#|V) -->\n```\nold\n```\nend\n"
    printed = {"asia show": "#01 a\nx\ny\nV 1\nlast\n"}
    assert tutorial.rewritten(page, printed) == page.replace("old", "#01 a\n...\nV 1")
    assert tutorial.shortened("a" * 130, "a") == "a" * 122 + " ...\n"


@pytest.mark.parametrize(
    ("shown", "printed"),
    [
        ("reference linear model  V=0.1", "rung linear model V=0.1"),
        ("#01 keep V=0.1 min fit 88.0 % 19s a | best #01 0.1", "#01 keep V=0.1 fit 88.0 % 19s a"),
        (" fold  V  top", " fold  V  fit s"),
    ],
)
def test_another_line_has_another_shape(shown: str, printed: str) -> None:
    assert shapes(shown) != shapes(printed)


def test_other_numbers_and_titles_have_the_same_shape() -> None:
    first = "#01 keep    V=0.1082  min fit  88.0 %          19s  baseline   | best #01 0.1082"
    other = "#03 discard V=1.4126  min fit -16.1 %        1m36s  neural: func... | best #02 0.1041"
    assert shapes(first) == shapes(other)


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, str]]:
    """A folder in which the tutorial was done, and what its commands printed."""
    folder = tmp_path_factory.mktemp("tutorial")
    return folder, tutorial.run_tutorial(smaller(PAGE), folder)


@pytest.mark.long
def test_the_outputs_shown_have_the_shape_of_those_printed(
    done: tuple[Path, dict[str, str]],
) -> None:
    page = tutorial.rewritten(smaller(PAGE), done[1])
    shown = outputs(smaller(PAGE))
    assert {name: shapes(shown[name]) - shapes(text) for name, text in outputs(page).items()} == {
        name: set() for name in shown
    }


def scores(folder: Path, name: str) -> list[float]:
    rows = (folder / "runs" / name / "results.tsv").read_text().splitlines()[1:]
    return [float(row.split("\t")[1]) for row in rows]


@pytest.mark.long
def test_both_searches_find_a_model_and_equations_help(done: tuple[Path, dict[str, str]]) -> None:
    linear, _ = scores(done[0], "tank-expert-s0")
    assert scores(done[0], "tank-physics")[-1] < linear / 2


@pytest.mark.long
def test_the_report_the_source_and_the_c_program_are_there(
    done: tuple[Path, dict[str, str]],
) -> None:
    folder, printed = done
    assert (folder / "runs" / "tank-expert-s0" / "report" / "residuals.png").is_file()
    assert "def fit(" in printed["asia show tank-physics --source"]
    assert (folder / "runs" / "tank-physics" / "export" / "c" / "model.c").is_file()


@pytest.mark.long
def test_the_model_is_used_from_python(done: tuple[Path, dict[str, str]]) -> None:
    assert float(done[1]["python use.py"].split()[1]) < 0.05
