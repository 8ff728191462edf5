"""No file of the package imports itself by way of others, imports inside functions included."""

import ast
import pkgutil
import re
import subprocess
import sys
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter
from importlib.util import resolve_name
from pathlib import Path

import pytest

import asia

SOURCE = Path(asia.__file__).parent
Graph = dict[str, set[str]]


def import_graph(folder: Path) -> Graph:
    """Module -> modules that its file imports. Imports for type checkers alone do not count, and an
    import of a package counts as one of its `__init__` file only."""
    files = {_module(folder, path): path for path in sorted(folder.rglob("*.py"))}
    graph: Graph = {}
    for module, path in files.items():
        package = module if path.name == "__init__.py" else module.rpartition(".")[0]
        found = _imported(ast.parse(path.read_text("utf-8")), package, frozenset(files))
        graph[module] = found - {module}
    return graph


def first_cycle(graph: Graph) -> list[str]:
    """The modules of a cycle, the first one repeated at the end; empty without a cycle."""
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return error.args[1]
    return []


def _module(folder: Path, path: Path) -> str:
    parts = path.relative_to(folder.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def _imported(tree: ast.AST, package: str, known: frozenset[str]) -> set[str]:
    found: set[str] = set()
    for node in _executed(tree):
        match node:
            case ast.Import(names=names):
                found.update(name.name for name in names)
            case ast.ImportFrom(module=module, names=names, level=level):
                base = resolve_name("." * level + (module or ""), package) if level else module
                # A submodule where there is one, otherwise a name that the package defines.
                whole = {f"{base}.{name.name}" for name in names}
                found |= (whole & known) or {str(base)}
                found |= {str(base)} if whole - known else set()
            case _:
                pass
    return found & known


def _executed(node: ast.AST) -> Iterator[ast.AST]:
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.If) and "TYPE_CHECKING" in ast.dump(child.test):
            for statement in child.orelse:
                yield statement
                yield from _executed(statement)
        else:
            yield child
            yield from _executed(child)


@pytest.mark.slow
def test_no_file_imports_itself_by_way_of_others() -> None:
    graph = import_graph(SOURCE)
    assert len(graph) > 200
    assert first_cycle(graph) == []


def test_a_cycle_through_functions_and_relative_imports_is_found(tmp_path: Path) -> None:
    package = tmp_path / "toy"
    package.mkdir()
    (package / "__init__.py").write_text("from toy.first import first\n")
    (package / "first.py").write_text("def first():\n    from . import second\n")
    (package / "second.py").write_text("import json\n")
    assert first_cycle(import_graph(package)) == []
    (package / "second.py").write_text("from toy.first import first\n")
    assert set(first_cycle(import_graph(package))) == {"toy.first", "toy.second"}
    (package / "second.py").write_text("from toy import first\n")
    assert set(first_cycle(import_graph(package))) == {"toy.first", "toy.second"}


def test_imports_for_type_checkers_make_no_cycle(tmp_path: Path) -> None:
    package = tmp_path / "toy"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "first.py").write_text("import toy.second\n")
    (package / "second.py").write_text(
        "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    import toy.first\n"
    )
    assert first_cycle(import_graph(package)) == []


EXTRAS = (
    *("openai", "httpx2", "mcp", "mcp_types", "starlette", "uvicorn", "equinox", "onnx", "casadi"),
    *("fmpy", "control", "h5py", "pyarrow", "openpyxl", "distributed", "pandas", "asammdf"),
)


def test_a_search_needs_no_extra() -> None:
    """What `asia run`, `show` and `report` import exists where ASIA was installed alone."""
    names = [
        f"asia.interfaces.cli.{path.stem}" for path in (SOURCE / "interfaces/cli").glob("*.py")
    ]
    names += [
        "asia.agents.registry",
        "asia.search.run",
        "asia.search.final",
        "asia.analysis.validation",
    ]
    names += [
        "asia.report.page",
        "asia.report.files",
        "asia.export.pipeline",
        "asia.interfaces.python",
    ]
    script = f"""
import sys
from importlib import import_module
sys.modules.update(dict.fromkeys({EXTRAS!r}))
for name in {sorted(names)!r}:
    import_module(name.removesuffix(".__init__"))
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_every_name_that_a_test_replaces_exists() -> None:
    """Also in tests that are run rarely: a name that has moved fails in the quick ones."""
    files = Path(__file__).parents[1].rglob("*.py")
    names = {
        name
        for path in files
        for name in re.findall(r'setattr\(\s*"(asia\.[\w.]+)"', path.read_text("utf-8"))
    }
    assert names
    for name in sorted(names):
        owner, _, attribute = name.rpartition(".")
        assert hasattr(pkgutil.resolve_name(owner), attribute), name
