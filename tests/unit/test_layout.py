"""Folders show the design: few files at the top of each, short files, short functions."""

import ast
from collections.abc import Iterator
from pathlib import Path

import asia

ROOT = Path(__file__).parents[2]
MOST_FILES, MOST_LINES, MOST_OF_A_FUNCTION = 15, 400, 50
# Folders with more files, and why.
LONGER = {
    "src/asia/models": "one public family a file",
    "src/asia/cli": "one command a file",
    "docs": "one page a subject",
}
Function = ast.FunctionDef | ast.AsyncFunctionDef


def crowded(folder: Path) -> Iterator[str]:
    """`folder` and those in it that hold more than 15 files, as `path: number`."""
    inside = [path for path in folder.rglob("*") if path.is_dir() and path.name != "__pycache__"]
    for place in (folder, *inside):
        files = [path for path in place.iterdir() if path.is_file()]
        if len(files) > MOST_FILES and place.name != "artifacts":
            yield f"{place.relative_to(ROOT).as_posix()}: {len(files)}"


def long_functions(source: str) -> list[str]:
    """Those of more than 50 lines, docstring apart, as `name: number`."""
    found = [node for node in ast.walk(ast.parse(source)) if isinstance(node, Function)]
    words = {node.name: ast.get_docstring(node, clean=False) for node in found}
    lengths = {
        node.name: node.end_lineno - node.lineno + 1 - len((words[node.name] or "").splitlines())
        for node in found
        if node.end_lineno
    }
    return [f"{name}: {length}" for name, length in lengths.items() if length > MOST_OF_A_FUNCTION]


def test_no_folder_is_crowded() -> None:
    places = [ROOT / name for name in ("src", "tests", "docs", "benchmarks")]
    found = [line for place in places for line in crowded(place)]
    assert [line for line in found if line.split(":")[0] not in LONGER] == []


def test_files_and_functions_of_the_package_are_short() -> None:
    files = sorted(Path(asia.__file__).parent.rglob("*.py"))
    texts = {path.relative_to(ROOT).as_posix(): path.read_text("utf-8") for path in files}
    assert [name for name, text in texts.items() if text.count("\n") > MOST_LINES] == []
    assert [f"{name} {line}" for name, text in texts.items() for line in long_functions(text)] == []


def test_a_long_function_is_seen() -> None:
    body = "    x = 1\n" * MOST_OF_A_FUNCTION
    text = f'def short():\n    pass\n\n\nasync def long():\n    """Text\n    of it."""\n{body}'
    assert long_functions(text) == ["long: 51"]
