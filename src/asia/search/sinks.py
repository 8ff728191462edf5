"""Sinks: receivers of the events of a search while it runs, besides its ledger."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import contextmanager, redirect_stdout
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final, Protocol, Self, cast

from asia._plugins import is_installed, library, load_target, parts_of
from asia._text import nearest, say
from asia.errors import UserError
from asia.ledger.chain import write_whole
from asia.ledger.events import Event
from asia.ledger.view import SearchView
from asia.search.loop import OnEvent


class Sink(Protocol):
    """Takes the events of one search. What it raises is reported and otherwise ignored."""

    def event(self, event: Event, view: SearchView) -> None:
        """The next event, which is in the ledger by now, and the search as of that event. Called
        from any thread, one call at a time; the search goes on when it returns."""
        ...

    def close(self) -> None:
        """The search returns, finished or interrupted."""
        ...


OpenSink = Callable[[Path, SearchView], Sink]
"""Opens a sink, given the run directory and the search so far: a search that is resumed has
events already. A class with these two arguments is one."""


@dataclass
class Sinks:
    """The sinks of one search, as a context manager that closes them.

    They are given what the ledger of a search holds, without the salt by which cases to check are
    drawn; the test is opened after a search, so no result of it is among the events.
    """

    directory: Path
    wanted: Mapping[str, OpenSink]
    """Function that opens each sink, by its name."""
    _open: dict[str, Sink] = field(default_factory=dict[str, Sink])
    _failed: set[str] = field(default_factory=set[str])

    def after_start(self, on_start: Callable[[SearchView], None]) -> Callable[[SearchView], None]:
        """`on_start`, then the sinks are opened."""

        def start(view: SearchView) -> None:
            on_start(view)
            for name, opener in self.wanted.items():
                with self._reported(name):
                    self._open[name] = opener(self.directory, _without_salt(view))

        return start

    def after_event(self, on_event: OnEvent) -> OnEvent:
        """`on_event`, then each sink is given the event."""

        def event(event: Event, view: SearchView) -> None:
            on_event(event, view)
            for name, sink in self._open.items():
                with self._reported(name):
                    sink.event(event, _without_salt(view))

        return event

    @contextmanager
    def _reported(self, name: str) -> Generator[None, None, None]:
        """Code of another package: its failure is never the search's, and is said once on
        stderr."""
        try:
            # The output of the command belongs to the command.
            with redirect_stdout(sys.stderr):
                yield
        except Exception as error:  # noqa: BLE001 - the boundary itself
            if name not in self._failed:
                self._failed.add(name)
                what = f"{type(error).__name__}: {error}"
                say(f"sink {name} failed, the search continues: {what}", file=sys.stderr)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *raised: object) -> None:
        for name, sink in self._open.items():
            with self._reported(name):
                sink.close()


def open_sinks(directory: Path, wanted: Sequence[str | OpenSink]) -> Sinks:
    """The sinks of a search in `directory`. wanted: names of installed sinks, `module:Name`, or
    what opens one. Raises UserError for a name that is not known."""
    found: dict[str, OpenSink] = {}
    for one in wanted:
        name = one if isinstance(one, str) else getattr(one, "__qualname__", repr(one))
        found[name] = find_sink(one) if isinstance(one, str) else one
    return Sinks(directory, found)


# The two sinks that come with ASIA: a run of MLflow or trackio for each search, with a step for
# each experiment. An experiment is sent once, also when the search is resumed or was finished
# before.


def _facts(view: SearchView) -> dict[str, str]:
    start = view.started
    return {
        "problem": start.problem, "agent": start.agent, "seed": str(start.seed),
        "isolation": start.isolation_words, "protocol": start.protocol_digest,
        "ASIA": start.environment.get("asia-sysid", ""),
    }  # fmt: skip


def unsent(view: SearchView, sent: set[int]) -> Generator[tuple[int, str, dict[str, float]]]:
    """Number, title and figures of each experiment with a result that was not sent; it counts as
    sent from now on."""
    for e in view.finished:
        if e.number in sent or e.result is None:
            continue
        sent.add(e.number)
        figures = {"seconds": e.result.seconds}
        if e.score is not None:
            figures["V"] = e.score.value
            figures |= {f"V_fold_{k}": fold.value for k, fold in enumerate(e.score.folds, 1)}
        best = [o.score.value for o in view.bests if o.number <= e.number and o.score]
        if best:
            figures["best_V"] = best[-1]
        yield e.number, f"{e.result.status}: {e.proposed.title}", figures


class MlflowSink:
    """Sends a search to MLflow, at `MLFLOW_TRACKING_URI`: a run in the experiment with the name of
    the problem, metrics by number of the experiment; at the end results.tsv, and report.html if
    `asia report` wrote it."""

    def __init__(self, directory: Path, view: SearchView) -> None:
        self.directory, self.client = directory, library("mlflow").MlflowClient()
        problem, place = view.started.problem, str(directory.resolve())
        found = self.client.get_experiment_by_name(problem)
        there = found.experiment_id if found else self.client.create_experiment(problem)
        known = self.client.search_runs([there], f"tags.asia_run = '{place}'")
        if known:
            self.run = known[0].info.run_id
            self.client.update_run(self.run, "RUNNING")
        else:
            made = self.client.create_run(
                there, run_name=view.started.run, tags={"asia_run": place}
            )
            self.run = made.info.run_id
            for key, text in _facts(view).items():
                self.client.log_param(self.run, key, text)
        history = self.client.get_metric_history(self.run, "seconds") if known else []
        self.sent = {metric.step for metric in history}
        self._send(view)

    def _send(self, view: SearchView) -> None:
        entities, now = library("mlflow.entities"), int(1000 * time.time())
        for number, title, figures in unsent(view, self.sent):
            best = "none" if view.best is None else f"#{view.best.number:02d}"
            tags = {f"experiment_{number:04d}": title, "best": best}
            self.client.log_batch(
                self.run,
                metrics=[
                    entities.Metric(key, value, now, number) for key, value in figures.items()
                ],
                tags=[entities.RunTag(key, text) for key, text in tags.items()],
            )

    def event(self, event: Event, view: SearchView) -> None:
        """See `Sink`."""
        self._send(view)

    def close(self) -> None:
        """See `Sink`."""
        for name in ("results.tsv", "report/report.html"):
            if (file := self.directory / name).is_file():
                self.client.log_artifact(self.run, str(file))
        self.client.set_terminated(self.run)


class TrackioSink:
    """Sends a search to trackio: a run in the project with the name of the problem, figures by
    number of the experiment. trackio keeps them on this machine."""

    def __init__(self, directory: Path, view: SearchView) -> None:
        start = view.started
        # What was sent is kept with the run: trackio has no public way to ask for it.
        self.kept = directory / "control" / "trackio.json"
        self.sent: set[int] = set()
        if self.kept.is_file():
            self.sent = set(map(int, json.loads(self.kept.read_bytes())))
        self.run = library("trackio").init(
            start.problem, name=start.run, config=_facts(view), resume="allow", embed=False
        )
        self._send(view)

    def _send(self, view: SearchView) -> None:
        for number, title, figures in unsent(view, self.sent):
            self.run.log({**figures, "candidate": title}, step=number)
        write_whole(self.kept, json.dumps(sorted(self.sent)).encode(), durable=False)

    def event(self, event: Event, view: SearchView) -> None:
        """See `Sink`."""
        self._send(view)

    def close(self) -> None:
        """See `Sink`."""
        self.run.finish()


_SINKS: Final[dict[str, OpenSink]] = {"mlflow": MlflowSink, "trackio": TrackioSink}


def find_sink(name: str) -> OpenSink:
    """The sink of this name or `module:Name`. Raises UserError where there is none."""
    known = {part.name: part for part in parts_of("asia.sinks")}
    if name in _SINKS:
        if not is_installed("mlflow" if name == "mlflow" else "trackio"):
            raise UserError(
                f"--sink {name} needs the extra tracking: pip install '.[tracking]' in a clone of "
                "ASIA"
            )
        return _SINKS[name]
    if name in known:
        sink = known[name].load()
    elif ":" in name:
        sink = load_target(name, f"sink {name}")
    else:
        close = nearest(name, {**_SINKS, **known})
        raise UserError(
            f"there is no sink '{name}'{close}: install the package that brings it, or name it as "
            "module:Name"
        )
    if not callable(sink):
        raise UserError(f"sink '{name}' is {sink!r}, expected a class or a function that opens one")
    return cast(OpenSink, sink)


def _without_salt(view: SearchView) -> SearchView:
    return replace(view, started=replace(view.started, salt=""))
