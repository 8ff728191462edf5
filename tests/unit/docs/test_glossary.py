"""One word, one meaning: names that users meet are made of the glossary's words and plain English,
and no class name is defined twice."""

import ast
import re
from collections import defaultdict
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
PACKAGE = ROOT / "src" / "asia"
SHOWN = (
    "errors.py",
    "ledger/_events/search.py",
    "ledger/_run.py",
    "protocol/_rules.py",
    "sandbox/_types.py",
    "evaluation/_relations.py",
)
"""Files whose Literal and enum values users read in messages, ledgers and problem files."""

# English words that need no line in the glossary: they mean in the code what they mean elsewhere.
PLAIN = """
absent again array attached bench bound brief check choice closing command compare comparison
contiguous contract cost count crash curve data diagnostics difference distance diverged done each
effort end ended entry environment equation error euclidean evaluated exchanged exec exempt
exhausted exited extended fact figure file finding finished finite fixed format geodesic held
honest hour index input interrupted invalid killed kind lack layers leave length library limit
line literal load local look looked machine make making memory name named none not note off on one
open opened order out output outside paper part picture plan planned prepared program published
quick range reached refitted refused reply report reproducible request result resumed row rule
running session settings shown side size sizes started state stated status stop stopped store
stored stream streamed stuck submitted sum summary suspect syntax table text time timeout token
tokens unsealed unsealing unsolicited usage user value verdict verified wait watcher whole with
without writer wrong training loss set arguments
"""
ABBREVIATIONS = "llm mae mee rmse mcp"

FAMILY_WORDS = {"Config"}
"""Every family has a class of this name: `linear.Config`, `narx.Config`."""


@cache
def tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(), str(path))


def modules() -> Iterator[tuple[str, ast.Module]]:
    for path in sorted(PACKAGE.rglob("*.py")):
        yield str(path.relative_to(PACKAGE)), tree(path)


@cache
def glossary() -> frozenset[str]:
    """Stems of the words that the glossary explains: its first column, and values in backticks."""
    page = (ROOT / "docs" / "glossary.md").read_text()
    rows = [line for line in page.splitlines() if line.startswith("| ")]
    heads = " ".join(row.split("|")[1] for row in rows)
    shown = " ".join(re.findall(r"`([a-z-]+)`", " ".join(rows)))
    return frozenset(stem(word) for word in re.findall(r"\w+", f"{heads} {shown}".lower()))


def stem(word: str) -> str:
    """One stem for `search`, `searches`, `searched`, `searching`."""
    return re.sub(r"(?<=\w{3})(ing|ed|er|or|es|s|e|al|ion)$", "", word)


def words_of(name: str) -> list[str]:
    """`FoldEvidence` and `fold_record` as words."""
    spaced = re.sub(r"([a-z0-9])([A-Z])", r"\1 \2", name)
    spaced = re.sub(r"([A-Z]+)([A-Z][a-z])", r"\1 \2", spaced)
    return [w.lower() for w in re.split(r"[\W_\d]+", spaced) if w]


def unknown(name: str) -> list[str]:
    known = glossary() | {stem(word) for word in (PLAIN + ABBREVIATIONS).split()}
    return [w for w in words_of(name) if stem(w) not in known]


def contract(module: ast.Module) -> tuple[str, ...]:
    """The names in a module's `__all__`."""
    for node in module.body:
        if isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None:
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            if any(isinstance(t, ast.Name) and t.id == "__all__" for t in targets):
                return tuple(ast.literal_eval(node.value))
    return ()


def values(module: ast.Module) -> Iterator[str]:
    """What Literals and enums of a module may be."""
    for node in ast.walk(module):
        if isinstance(node, ast.Subscript) and isinstance(node.value, ast.Name):
            if node.value.id == "Literal":
                inner = node.slice.elts if isinstance(node.slice, ast.Tuple) else [node.slice]
                yield from (str(e.value) for e in inner if isinstance(e, ast.Constant))
        elif isinstance(node, ast.ClassDef) and any(
            isinstance(base, ast.Name) and base.id == "StrEnum" for base in node.bases
        ):
            for line in node.body:
                if isinstance(line, ast.Assign) and isinstance(line.value, ast.Constant):
                    yield str(line.value.value)


def test_public_class_names_are_made_of_the_glossarys_words() -> None:
    strange: dict[str, list[str]] = {}
    for where, module in modules():
        if where.endswith("__init__.py"):
            for name in contract(module):
                if name[0].isupper() and not name.isupper() and unknown(name):
                    strange[f"{where}: {name}"] = unknown(name)
    assert not strange, "name these otherwise, or add the word to docs/glossary.md"


def test_functions_of_the_package_are_made_of_the_glossarys_words() -> None:
    assert contract(tree(PACKAGE / "__init__.py"))
    names = contract(tree(PACKAGE / "__init__.py")) + contract(
        tree(PACKAGE / "testing/__init__.py")
    )
    assert {name: unknown(name) for name in names if unknown(name)} == {}


@pytest.mark.parametrize("where", SHOWN)
def test_values_that_users_read_are_made_of_the_glossarys_words(where: str) -> None:
    shown = sorted(set(values(tree(PACKAGE / where))))
    assert shown
    assert {value: unknown(value) for value in shown if unknown(value)} == {}


def test_no_class_name_has_two_meanings() -> None:
    places: dict[str, list[str]] = defaultdict(list)
    for where, module in modules():
        for node in ast.walk(module):
            if isinstance(node, ast.ClassDef):
                places[node.name].append(where)
    twice = {name: where for name, where in places.items() if len(where) > 1}
    families = {name: where for name, where in twice.items() if name in FAMILY_WORDS}
    assert all(path.startswith("models/") for where in families.values() for path in where)
    others = {name: where for name, where in twice.items() if name not in FAMILY_WORDS}
    assert not others, "one class name, one meaning: rename one of the two"


def test_the_words_of_the_glossary_are_told_once() -> None:
    page = (ROOT / "docs" / "glossary.md").read_text()
    rows = [line.split("|")[1].strip() for line in page.splitlines() if line.startswith("| ")]
    rows = [row for row in rows if row != "word"]
    assert len(rows) == len(set(rows))
