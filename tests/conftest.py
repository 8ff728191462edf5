"""What all tests share."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from asia.evaluation import LINEAR
from tests.compiled import compile_cheaply, kept

compile_cheaply()

QUICK = Path(__file__).parent / "quick"
_RUNG = "asia.evaluation._rungs.LINEAR"


@pytest.fixture(scope="session", autouse=True)
def quick_linear_rung() -> Iterator[None]:
    """The linear model that every search reports, without compiling anything: here, and in the
    processes that tests start."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(_RUNG, (QUICK / "arx.py").read_text("utf-8"))
        patch.setenv("PYTHONPATH", str(QUICK), prepend=":")
        yield


@pytest.fixture
def real_linear_rung(monkeypatch: pytest.MonkeyPatch) -> None:
    """For the tests whose subject it is."""
    monkeypatch.setattr(_RUNG, LINEAR)


@pytest.fixture(scope="session", autouse=True)
def compiled_once(pytestconfig: pytest.Config) -> Iterator[None]:
    """A program that an earlier test or an earlier run compiled is not compiled again."""
    with kept(pytestconfig.rootpath / "build" / "compiled"):
        yield
