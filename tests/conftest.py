"""Fixtures and settings of all tests."""

import os
import shutil
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from zlib import crc32

import pytest
from hypothesis import settings

from asia._files import config_folder
from asia.judge.evaluation.references import LINEAR
from tests.compiled import compile_cheaply, kept
from tests.once import made_once
from tests.unit.search.toy import CRASH, arx, search_toy

compile_cheaply()
# Forty examples of a property find what a hundred find, but for the rarest cases.
settings.register_profile("ci", settings.get_profile("ci"), max_examples=40)
# A shell starts what runs in its background with interrupts ignored, and children inherit that: a
# search that a test interrupts would go on.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

QUICK = Path(__file__).parent / "quick"
_RUNG = "asia.judge.evaluation.references.LINEAR"
_LONG = (
    "agents",
    "interfaces",
    "contract",
    "models",
    "redteam",
    "report",
    "search",
)
"""Folders of files that take long."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Files that take long come first, so that no worker is left with one at the end, and mixed,
    so that those that compute run beside those that wait for processes."""

    def place(item: pytest.Item) -> tuple[bool, int]:
        file = item.nodeid.partition("::")[0]
        return not set(_LONG) & set(Path(file).parts), crc32(file.encode())

    items.sort(key=place)


@pytest.fixture(scope="session", autouse=True)
def quick_linear_reference() -> Iterator[None]:
    """The linear model that every search reports, without compiling anything: here, and in the
    processes that tests start."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(_RUNG, (QUICK / "arx.py").read_text("utf-8"))
        patch.setenv("PYTHONPATH", str(QUICK), prepend=":")
        yield


@pytest.fixture(scope="session", autouse=True)
def own_folders(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Links of workspaces, tokens and indexes are kept in folders of the tests, here and in the
    processes that tests start. The fonts that matplotlib has found are shared."""
    home = tmp_path_factory.mktemp("home")
    (home / "cache").mkdir()
    (home / "config").mkdir()
    fonts = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "matplotlib"
    fonts.mkdir(parents=True, exist_ok=True)
    (home / "cache" / "matplotlib").symlink_to(fonts)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CONFIG_HOME", str(home / "config"))
        patch.setenv("XDG_CACHE_HOME", str(home / "cache"))
        yield


@pytest.fixture(scope="session")
def finished_once(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with the problem `toy` and a finished search in `runs`: the baseline, a better one, a
    crash and a twin."""
    return made_once(
        tmp_path_factory, "finished", lambda root: search_toy(root, arx(2), CRASH, arx(2))
    )


@pytest.fixture
def finished(finished_once: Path, tmp_path: Path) -> Path:
    """Run directory of a copy of it in `tmp_path`, to change at will."""
    shutil.copytree(finished_once, tmp_path, dirs_exist_ok=True)
    return tmp_path / "runs" / "toy-scripted-s0"


@pytest.fixture
def real_linear_reference(monkeypatch: pytest.MonkeyPatch) -> None:
    """For the tests whose subject it is."""
    monkeypatch.setattr(_RUNG, LINEAR)


@pytest.fixture(scope="session", autouse=True)
def compiled_once(pytestconfig: pytest.Config) -> Iterator[None]:
    """A program that an earlier test or an earlier run compiled is not compiled again."""
    with kept(pytestconfig.rootpath / "build" / "compiled"):
        yield


@pytest.fixture(autouse=True)
def default_precision() -> Iterator[None]:
    """A model that is lowered turns on double precision, in a search for its own process alone."""
    yield
    if "jax" in sys.modules:
        sys.modules["jax"].config.update("jax_enable_x64", False)


@pytest.fixture(autouse=True)
def no_looks_of_other_tests() -> Iterator[None]:
    """Copies of one run are used by many tests, each of which may be the first to open its test."""
    yield
    shutil.rmtree(config_folder() / "looks", ignore_errors=True)
