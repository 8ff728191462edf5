"""Workspace: a folder in which a user or a coding agent works on a problem. It holds training data
and texts, never test data, never the ledger itself.
"""

from __future__ import annotations

import csv
import io
import json
import math
import os
from dataclasses import dataclass
from pathlib import Path

from pydantic import TypeAdapter

from asia.data import Trajectory
from asia.drive._desk import Desk, RunDesk
from asia.drive._detached import SearchRequest, start_search
from asia.drive._program import Confinement, models_page, program
from asia.drive._scripts import PLOT, TOOLS
from asia.drive._socket import SocketDesk
from asia.drive._write_file import write_file
from asia.errors import UserError
from asia.evaluation import LINEAR
from asia.ledger import SearchView, Store, journal, open_run, published, results_table
from asia.problem.load import Problem, training_text
from asia.report import SimulatedCases, draw_cases
from asia.search._run import Prepared

DESK_VARIABLE = "ASIA_DESK"
CANDIDATE = "candidate.py"
VIEWS = ("results.tsv", "search_journal.md")
_LINK = ".asia/workspace.json"
_links = TypeAdapter(dict[str, str | None])


@dataclass(frozen=True)
class Workspace:
    """A folder to work in, and the run that it belongs to."""

    folder: Path
    """Folder with data, texts and candidate.py."""
    run: Path | None
    """The run directory; None where the folder is that of a command agent, which reaches its
    search through the socket alone."""

    @classmethod
    def find(cls, folder: Path) -> Workspace:
        """Return the workspace of a folder or one above it.

        Raises:
            UserError: there is none.
        """
        found = cls.around(folder)
        if found is None:
            raise UserError(
                f"{folder} is not in a workspace: make one with asia agent workspace PROBLEM DIR, "
                "then cd DIR"
            )
        return found

    @classmethod
    def around(cls, folder: Path) -> Workspace | None:
        """Return the workspace as `find`; None if there is none."""
        for place in (folder.resolve(), *folder.resolve().parents):
            link = place / _LINK
            if link.is_file():
                return cls(place, _run_of(link))
        return None

    def desk(self) -> Desk:
        """Return the submission server: the socket that ASIA_DESK names, else the run itself."""
        path = os.environ.get(DESK_VARIABLE)
        if path:
            return SocketDesk(Path(path))
        run = self._own_run()
        request = SearchRequest.find(run)
        if request is not None and request.settings.get("jail"):
            raise UserError(
                f"the ledger of {run.name} says that its candidates come from a jail: submit from "
                "the program that asia agent workspace --jail starts, or make another workspace "
                "with another --name"
            )
        return RunDesk(run, start_search)

    def draw(self, experiment: int, cases: SimulatedCases) -> tuple[str, ...]:
        """Pictures of an experiment in `plots/`; the names of the files. Raises UserError."""
        names: list[str] = []
        for what, picture in draw_cases(cases).items():
            ending = "" if what == "simulation" else f"-{what}"
            names.append(f"plots/{experiment:03d}{ending}.png")
            write_file(self.folder, names[-1], picture)
        return tuple(names)

    def _own_run(self) -> Path:
        if self.run is None:
            raise UserError(
                f"{self.folder} belongs to the search of a coding agent, and only this "
                "agent submits from it; make your own workspace with asia agent workspace "
                "PROBLEM DIR"
            )
        return self.run

    def renew_views(self) -> None:
        """Write results.tsv, search_journal.md and best.py from the present ledger. In a jail the
        process with the socket writes them.
        """
        if DESK_VARIABLE not in os.environ:
            opened = open_run(self._own_run())
            write_views(self.folder, opened.view, opened.store)


def is_workspace(folder: Path) -> bool:
    """Return whether `asia agent workspace` or a command agent made this folder."""
    return (folder / _LINK).is_file()


def _run_of(link: Path) -> Path | None:
    """Return the run directory that a workspace names.

    Raises:
        UserError: the link cannot be read.
    """
    try:
        run = _links.validate_json(link.read_bytes()).get("run")
    except (OSError, ValueError):
        raise UserError(
            f"{link} is damaged: make the workspace again, with the command that made it"
        ) from None
    return Path(run) if run else None


def make_workspace(
    folder: Path,
    prepared: Prepared,
    request: SearchRequest,
    confinement: Confinement = Confinement.OPEN,
) -> Workspace:
    """Write the folder; what its user has written stays. Raises UserError for a folder with other
    things in it, or of another run."""
    folder = folder.resolve()
    run = prepared.directory.resolve()
    if (folder / _LINK).is_file():
        other = Workspace.find(folder).run
        if other != run:
            raise UserError(
                f"{folder} is the workspace of {other.name if other else 'a coding agent'}; choose "
                "another folder"
            )
    elif folder.is_dir() and any(folder.iterdir()):
        raise UserError(f"{folder} is not empty: give a new folder")
    if folder == run or run in folder.parents or folder in run.parents:
        raise UserError(
            f"{folder} and the run directory {run}: one contains the other, but a workspace "
            "must not show the ledger; choose another folder"
        )
    started = prepared.started
    problem, experiments = prepared.problem, started.experiments
    write_folder(folder, problem, experiments, run, started.seed, confinement)
    request.save(run)
    return Workspace(folder, run)


def write_folder(
    folder: Path,
    problem: Problem,
    experiments: int,
    run: Path | None = None,
    seed: int = 0,
    confinement: Confinement = Confinement.OPEN,
) -> None:
    """The files of a workspace; `run` as in `Workspace`, `seed` of its search."""
    folder.mkdir(parents=True, exist_ok=True)
    write_file(folder, "PROGRAM.md", program(problem, experiments, confinement))
    write_file(folder, "description.md", problem.description)
    write_file(folder, "models.md", models_page(problem))
    write_file(folder, "plot.py", PLOT)
    names = trajectory_names(problem.train)
    write_file(folder, "problem.toml", training_text(problem, names))
    write_file(folder, "tools.py", TOOLS.replace("{seed}", str(seed)))
    for name, trajectory in zip(names, problem.train, strict=True):
        write_file(folder, f"data/{name}.csv", _csv(trajectory, problem))
    if not os.path.lexists(folder / CANDIDATE):
        write_file(folder, CANDIDATE, problem.baseline or LINEAR)
    write_file(folder, _LINK, json.dumps({"run": str(run) if run else None}) + "\n")


def write_views(folder: Path, view: SearchView, store: Store) -> None:
    """Write results.tsv and search_journal.md with the reported scores, read-only, and the best
    candidate.
    """
    view = published(view)
    texts = {VIEWS[0]: results_table(view), VIEWS[1]: journal(view)}
    if view.best is not None:
        texts["best.py"] = store.text(view.best.proposed.source)
    for name, text in texts.items():
        write_file(folder, name, text, mode=0o444)


def trajectory_names(trajectories: tuple[Trajectory, ...]) -> list[str]:
    """File names, one a trajectory, all different."""
    stems = [
        "".join(c if c.isalnum() or c in "-_." else "_" for c in r.name).strip(".") or f"record{i}"
        for i, r in enumerate(trajectories, 1)
    ]
    return [f"{s}-{i}" if stems.count(s) > 1 else s for i, s in enumerate(stems, 1)]


def _csv(trajectory: Trajectory, problem: Problem) -> str:
    """A trajectory as CSV, time first; empty where an output was not measured."""
    names = [s.name for s in (*problem.inputs, *problem.outputs)]
    stream = io.StringIO()
    table = csv.writer(stream, lineterminator="\n")
    table.writerow(["time", *names])
    measured = trajectory.measured_y
    for k in range(len(trajectory)):
        values = [*trajectory.u[k].tolist(), *measured[k].tolist()]
        row = ("" if math.isnan(value) else repr(value) for value in values)
        table.writerow([repr(k * trajectory.sampling_time), *row])
    return stream.getvalue()
