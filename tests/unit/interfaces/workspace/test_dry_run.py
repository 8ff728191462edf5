"""A dry run beside a search: what it finds, and that it leaves no trace."""

import contextlib
import threading
from pathlib import Path

import pytest

from asia.errors import UserError
from asia.interfaces.workspace.process import serve
from asia.interfaces.workspace.server import (
    DeskServer,
    DryRunResult,
    RunDesk,
    SocketDesk,
    printed_lines,
)
from tests.unit.search.toy import CRASH, NOISE, arx

from .desks import Place, ordered

TALKS = arx(2).replace(
    "    context.log(", "    print('held', len(trajectories[0]))\n    context.log("
)
DIVERGES = arx(2).replace("return y[:, k0:]", "return y[:, k0:] * np.nan")


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Place:
    made = ordered(tmp_path_factory.mktemp("dry"))
    serve(made.directory, idle_seconds=0.0)
    return made


def files(directory: Path) -> dict[str, bytes]:
    return {str(p): p.read_bytes() for p in directory.rglob("*") if p.is_file()}


@pytest.mark.slow
def test_a_dry_run_leaves_the_run_as_it_was(place: Place) -> None:
    before = files(place.directory)
    found = place.desk.dry_run(TALKS)
    assert found.reason is None
    assert found.printed == ("held 118",)
    assert found.samples == 118
    assert found.fit_seconds is not None
    assert found.limit_seconds == found.allowed_seconds == 20.0
    assert files(place.directory) == before
    assert len(place.desk.results()) == 1


@pytest.mark.parametrize(
    ("source", "reason"),
    [
        ("def fit(:", "syntax"),
        (CRASH, "crash"),
        (NOISE, "not_reproducible"),
        (DIVERGES, "not_finite"),
        (arx(2).replace("[:, k0:]", "[:, k0 + 1:]"), "wrong_length"),
    ],
)
def test_a_dry_run_names_what_a_try_would_fail_with(place: Place, source: str, reason: str) -> None:
    found = place.desk.dry_run(source)
    assert found.reason == reason
    assert found.advice
    assert found.fit_seconds is None or reason == "not_reproducible"


def test_a_dry_run_gives_nothing_that_could_be_a_score() -> None:
    """The report on a good candidate has times and sizes."""
    assert set(DryRunResult.__dataclass_fields__) == {
        "reason", "advice", "detail", "printed", "samples", "of_samples", "fit_seconds",
        "compile_seconds", "simulate_seconds", "whole_fit_seconds", "limit_seconds",
        "allowed_seconds", "lines",
    }  # fmt: skip


def test_a_dry_run_over_a_socket(place: Place, tmp_path: Path) -> None:
    with DeskServer(tmp_path / "s", place.desk):
        assert (
            SocketDesk(tmp_path / "s").dry_run(CRASH).detail == "line 2: ValueError: no such luck"
        )


def test_one_dry_run_at_a_time(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    inside, go = threading.Event(), threading.Event()

    def slow(run: object, source: str, isolation: object) -> None:
        del run, source, isolation
        inside.set()
        go.wait(20.0)
        raise UserError("ended")

    monkeypatch.setattr("asia.interfaces.workspace.server.dry_run", slow)
    desk = RunDesk(place.directory)

    def ask() -> None:
        with contextlib.suppress(UserError):
            desk.dry_run(arx(2))

    first = threading.Thread(target=ask)
    first.start()
    assert inside.wait(20.0)
    with pytest.raises(UserError, match="in progress"):
        desk.dry_run(arx(2))
    go.set()
    first.join()
    with pytest.raises(UserError, match="ended"):
        desk.dry_run(arx(2))


def test_lines_of_the_sandbox_are_not_the_candidates() -> None:
    assert printed_lines("[mutex.cc : 1] RAW: failed\nmine\x1b[2J\n") == (
        "mine\N{REPLACEMENT CHARACTER}[2J",
    )
