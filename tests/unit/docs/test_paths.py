"""Links, files and modules that the documents name exist in a clone."""

import re
import subprocess
from functools import cache
from importlib import import_module
from pathlib import Path

import pytest

from asia._plugins import GROUPS

ROOT = Path(__file__).parents[3]
PACKAGE = ROOT / "src" / "asia"
PAGES = sorted(
    page
    for folder, pattern in (
        (ROOT, "*.md"),
        (ROOT / "docs", "**/*.md"),
        (ROOT / "benchmarks", "*.md"),
    )
    for page in folder.glob(pattern)
    if page.name != "RESULTS.md"
)
FILE = re.compile(r"`((?:[\w.<>*-]+/)+(?:[\w.<>*-]+)?|[\w*-]+\.(?:py|yml|cff))`")
MODULE = re.compile(r"\basia(?:\.[A-Za-z_]\w*)+")
# Files and folders of a reader's machine, or of a run.
MADE = re.compile(
    r"candidate\.py|baseline\.py|best\.py|controller\.py|plot\.py|tools\.py|plots/|conftest\.py|sitecustomize\.py|mytool|runs/|/proc|"
    r"/tmp|/var|/dev|/usr|/etc|~|mill/|control/queue|artifacts/|report/|data/$|build/|\.venv|<|"
    r"\.gemini|\.codex|Qwen/|bench-|RUNS/|nonlinear_benchmarks/|^tank/|^measure\.py|^use\.py|^nanodrone/|^(model|system)\.py$"
)


def name(page: Path) -> str:
    return str(page.relative_to(ROOT))


@cache
def tracked() -> frozenset[str]:
    """Files of the repository, and the folders they lie in."""
    listing = ("git", "ls-files", "--cached", "--others", "--exclude-standard")
    files = subprocess.run(listing, cwd=ROOT, capture_output=True, text=True, check=True)
    paths = [Path(line) for line in files.stdout.splitlines()]
    folders = {f"{parent}/" for path in paths for parent in path.parents}
    return frozenset({*map(str, paths), *folders})


def anchors(page: Path) -> set[str]:
    """Headings of a page as a Git host names them."""
    text = re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL)
    heads = re.findall(r"^#+ (.+)$", text, flags=re.MULTILINE)
    return {re.sub(r"[^\w -]", "", head.lower()).strip().replace(" ", "-") for head in heads}


def exists(path: str, page: Path) -> bool:
    if "/" not in path:
        return any(page.parent.rglob(path))
    places = ("", f"{page.parent.relative_to(ROOT)}/", "src/asia/")
    wanted = [
        re.escape(place.removeprefix("./") + path).replace(r"\*", "[^/]*") for place in places
    ]
    return any(re.fullmatch(f"{w}/?", file) for w in wanted for file in tracked())


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_links_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\((?!https?:|mailto:)([^)]+)\)", page.read_text()):
        path, _, anchor = target.partition("#")
        file = (page.parent / path) if path else page
        assert file.exists(), f"{name(page)}: {target}"
        if anchor:
            assert anchor in anchors(file), f"{name(page)}: {target}"


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_files_that_are_named_exist(page: Path) -> None:
    named = [path for path in FILE.findall(page.read_text()) if not MADE.search(path)]
    missing = [path for path in named if not exists(path, page)]
    assert not missing, f"{name(page)} names files that do not exist"


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_modules_that_are_named_exist(page: Path) -> None:
    for dotted in sorted(set(MODULE.findall(page.read_text()))):
        assert found(dotted), f"{name(page)} names {dotted}"


def found(dotted: str) -> bool:
    """Whether it is an entry point, a module, or a name in a module or a class."""
    return dotted in GROUPS or bool(named(dotted))


def named(dotted: str) -> list[object]:
    """The module or object of that name, none where there is no such thing."""
    try:
        return [import_module(dotted)]
    except ModuleNotFoundError:
        outer, _, attribute = dotted.rpartition(".")
        owners = named(outer) if outer else []
        return [getattr(owner, attribute) for owner in owners if hasattr(owner, attribute)]
