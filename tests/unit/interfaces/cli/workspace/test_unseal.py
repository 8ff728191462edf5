"""Opening the test of a workspace whose search still waits for candidates."""

import time
from dataclasses import replace
from pathlib import Path

import pytest

from asia.interfaces.workspace.process import SearchRequest, attended, start_search
from asia.interfaces.workspace.server import RunDesk
from asia.ledger.run import open_run
from tests.unit.interfaces.cli.conftest import Asia
from tests.unit.interfaces.workspace.desks import Place, candidate, end_searches, ordered
from tests.unit.search.toy import arx


@pytest.fixture
def idle(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Place:
    """Its baseline is judged, its search waits, and experiments are left."""
    monkeypatch.chdir(tmp_path)
    place = ordered(tmp_path)
    (place.problem / "baseline.py").write_text(arx(1))
    start_search(place.directory)
    while not open_run(place.directory).view.finished:
        time.sleep(0.05)
    return place


@pytest.mark.long
@pytest.mark.parametrize("there", [True, False])
def test_unsealing_ends_a_search_that_waits(idle: Place, asia: Asia, there: bool) -> None:
    if not there:
        end_searches(idle.directory)
    try:
        done = asia("unseal", idle.directory.name, "--yes", "--yes-process")
        assert done.code == 0, done.err
        assert "the search ends after refitting the best candidate" in done.err
        view = open_run(idle.directory).view
        assert view.unsealed is not None
        assert view.stopped is not None
        assert view.stopped.reason == "user"
        assert not attended(idle.directory)
    finally:
        end_searches(idle.directory)


def test_unsealing_does_not_end_a_search_with_a_candidate(idle: Place, asia: Asia) -> None:
    end_searches(idle.directory)
    RunDesk(idle.directory).submit(candidate(2))
    done = asia("unseal", idle.directory.name, "--yes", "--yes-process")
    assert done.code == 2
    assert "is not idle (1 candidates wait" in done.err
    assert open_run(idle.directory).view.stopped is None


def test_files_of_a_run_do_not_choose_a_weaker_level(idle: Place, asia: Asia) -> None:
    end_searches(idle.directory)
    replace(SearchRequest.load(idle.directory), isolation="process").save(idle.directory)
    done = asia("unseal", idle.directory.name, "--yes", "--yes-process")
    assert done.code == 2
    assert "give --isolation process if the run is your own" in done.err
    assert not open_run(idle.directory).view.complete
