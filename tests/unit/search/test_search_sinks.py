"""Sinks: the suite, and that a search neither stops nor changes with them."""

import sys
from pathlib import Path

import pytest

import asia
from asia.errors import UserError
from asia.ledger.chain import Chain
from asia.ledger.events import Evaluated, Event, Stopped
from asia.ledger.view import SearchView
from asia.search.sinks import Sinks, find_sink, open_sinks, unsent
from asia.testing import check_sink
from asia.testing.ledger import made_up_events
from tests.unit.made_up_parts import installed
from tests.unit.search.toy import Scripted, arx, write_problem

SOURCE = """
class Lines:
    def __init__(self, directory, view):
        self.file = (directory / "events.txt").open("a")

    def event(self, event, view):
        print(event.event, file=self.file, flush=True)

    def close(self):
        self.file.close()

nothing = 3
"""


class Kept:
    """Keeps what it is given."""

    def __init__(self, directory: Path, view: SearchView) -> None:
        self.events: list[Event] = []
        self.views, self.closed = [view], False

    def event(self, event: Event, view: SearchView) -> None:
        self.events.append(event)
        self.views.append(view)

    def close(self) -> None:
        self.closed = True


class Broken(Kept):
    def event(self, event: Event, view: SearchView) -> None:
        raise OSError("no such host")

    def close(self) -> None:
        raise ValueError("not open")


def broken_at_once(directory: Path, view: SearchView) -> Kept:
    raise OSError("no such host")


def test_the_suite() -> None:
    check_sink(Kept)
    for broken in (Broken, broken_at_once):
        with pytest.raises(OSError, match="no such host"):
            check_sink(broken)


def test_a_sink_that_writes_into_the_ledger_fails_the_suite() -> None:
    class Writing(Kept):
        def __init__(self, directory: Path, view: SearchView) -> None:
            super().__init__(directory, view)
            with (directory / "ledger.jsonl").open("a") as file:
                file.write("{}\n")

    with pytest.raises(AssertionError, match="ledger was changed"):
        check_sink(Writing)


@pytest.mark.slow
def test_a_search_goes_to_every_sink_and_a_broken_one_is_reported_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    kept: list[Kept] = []

    def keep(directory: Path, view: SearchView) -> Kept:
        kept.append(Kept(directory, view))
        return kept[-1]

    problem = write_problem(tmp_path / "toy", experiments=2)
    run = asia.run(problem, agent=Scripted((arx(2),)), runs=tmp_path / "runs", sinks=[Broken, keep])
    (sink,) = kept
    assert sink.closed
    assert sink.events == [line.event for line in run.lines][1:]
    assert [type(e) for e in sink.events].count(Evaluated) == 2
    assert any(isinstance(e, Stopped) for e in sink.events)
    assert run.view.started.salt
    assert {view.started.salt for view in sink.views} == {""}
    said = capsys.readouterr().err
    assert said == "sink Broken failed, the search continues: OSError: no such host\n"


def test_sinks_are_found_by_name_and_by_module(tmp_path: Path) -> None:
    points = "[asia.sinks]\nlines = made_up_sink:Lines\nnothing = made_up_sink:nothing\n"
    with installed(tmp_path, "made_up_sink", SOURCE, points):
        check_sink(find_sink("lines"))
        assert find_sink("lines") is find_sink("made_up_sink:Lines")
        with pytest.raises(UserError, match=r"'line'.*did you mean 'lines'"):
            open_sinks(tmp_path, ["line"])
        with pytest.raises(UserError, match="is 3, expected a class"):
            find_sink("nothing")


def test_without_sinks_nothing_is_added(tmp_path: Path) -> None:
    seen: list[object] = []
    with Sinks(tmp_path, {}) as sinks:
        sinks.after_event(lambda event, view: seen.append(event))
    assert seen == []


@pytest.mark.long
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", ["mlflow", "trackio"])
def test_the_sinks_of_asia_pass_the_suite(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip(name, reason="needs the extra tracking")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("TRACKIO_DIR", str(tmp_path / "trackio"))
    monkeypatch.setenv("MLFLOW_TRACKING_URI", f"sqlite:///{tmp_path}/mlflow.db")
    check_sink(find_sink(name))


def test_an_experiment_is_sent_once_with_its_figures(tmp_path: Path) -> None:
    with Chain(tmp_path / "ledger.jsonl") as chain:
        for event in made_up_events():
            chain.append(event)
        view = chain.view
    sent: set[int] = set()
    found = {number: (title, figures) for number, title, figures in unsent(view, sent)}
    assert list(found) == [e.number for e in view.finished]
    for e in view.finished:
        title, figures = found[e.number]
        assert e.result is not None
        assert title == f"{e.result.status}: {e.proposed.title}"
        assert figures.get("V") == (e.score.value if e.score else None)
    assert list(unsent(view, sent)) == []


def test_without_the_library_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "trackio", None)
    with pytest.raises(UserError, match=r"--sink trackio needs the extra tracking"):
        find_sink("trackio")
