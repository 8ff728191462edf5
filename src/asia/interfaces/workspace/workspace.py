"""Workspace: a folder in which a user or a coding agent works on a problem."""

from __future__ import annotations

import csv
import io
import math
import os
import sys
from dataclasses import dataclass
from pathlib import Path

from asia._files import write_file
from asia.data.intake.frequency import write_response
from asia.data.trajectory import Trajectory
from asia.errors import UserError
from asia.interfaces.workspace.process import SearchRequest, start_search
from asia.interfaces.workspace.program import Confinement, models_page, program
from asia.interfaces.workspace.server import RunDesk, SocketDesk
from asia.judge.evaluation.references import LINEAR
from asia.judge.sandbox.types import Isolation
from asia.ledger.artifacts import Store
from asia.ledger.folder import MARK, link_workspace, linked_workspace, workspace_around
from asia.ledger.run import open_run
from asia.ledger.simulated import SimulatedCases
from asia.ledger.view import SearchView
from asia.presentation.exports import journal, results_table
from asia.problem.problem import Problem, training_text
from asia.report.files import draw_cases
from asia.search.run import Prepared

# Scripts that a workspace comes with.


PLOT = '''"""Draws the training records: python plot.py [data/NAME.csv ...] -> data.png"""

import csv
import sys
import tomllib
from pathlib import Path

try:
    import matplotlib
except ModuleNotFoundError as missing:
    sys.exit(f"plot.py: {missing}; start it with " + {python})

matplotlib.use("Agg")
import matplotlib.pyplot as plt

problem = tomllib.loads(Path("problem.toml").read_text("utf-8"))
units = {s["name"]: s.get("unit", "") for s in [*problem["inputs"], *problem["outputs"]]}
paths = [Path(p) for p in sys.argv[1:]] or sorted(Path("data").glob("*.csv"))
for path in paths[:8]:
    with path.open(newline="") as stream:
        header, *rows = csv.reader(stream)
    columns = list(zip(*[[float(cell) for cell in row] for row in rows]))
    figure, axes = plt.subplots(len(header) - 1, 1, sharex=True, figsize=(10, 1.6 * len(header)))
    for axis, name, values in zip(figure.axes, header[1:], columns[1:]):
        axis.plot(columns[0], values, linewidth=0.8)
        unit = units.get(name)
        axis.set_ylabel(f"{name} [{unit}]" if unit else name, rotation=0, ha="right")
    figure.axes[-1].set_xlabel(f"{header[0]} [s]")
    figure.suptitle(path.stem)
    name = "data.png" if len(paths) == 1 else f"data-{path.stem}.png"
    figure.savefig(name, bbox_inches="tight", dpi=120)
    print(name)
'''


TOOLS = '''"""Scores a candidate on training records as the evaluator does, and shows its residuals.

    python tools.py                   candidate.py on the folds of V
    python tools.py best.py --fold 1  another file, one fold
    python tools.py a.py b.py         several files, one row each
    python tools.py --blocks 5        folds of your own: each record in five parts
    python tools.py --hold-out A,B    a fold of your own: these records held out, the others train
    python tools.py --seed 1          another seed of the fits: spread of V
    python tools.py --vary order=2,3  V for values of a setting, also one that candidate.py leaves
                                      at its default; repeatable, for combinations
    python tools.py --why             parts of the error, modes, terms that may be missing
    python tools.py --plot            also draw simulation and residuals into plots/

It costs no experiment. The candidate runs in this process, without sandbox, time limit or memory
limit. In a script of your own:

    from tools import TOOLS
    for fold, fit in TOOLS.evaluate("candidate.py"):
        print(fold.value, fold.parameters, fold.residuals, fit.model)
"""

import sys
from pathlib import Path

try:
    from asia.interfaces.workspace.tools import WorkspaceTools, main
except ModuleNotFoundError as missing:
    sys.exit(f"tools.py: {missing}; start it with " + {python})

TOOLS = WorkspaceTools(Path(__file__).parent, seed={seed})

if __name__ == "__main__":
    main(TOOLS)
'''


# Workspace: a folder in which a user or a coding agent works on a problem. It holds training data
# and texts, never test data, never the ledger itself.


DESK_VARIABLE = "ASIA_DESK"
CANDIDATE = "candidate.py"
VIEWS = ("results.tsv", "search_journal.md")


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
        """Return the workspace as `find`; None if there is none. Its run is the one that was
        recorded outside it: nothing in the folder, which an agent can write, names a run."""
        place = workspace_around(folder)
        if place is None:
            return None
        link = linked_workspace(place)
        return cls(place, None if link is None else link.run)

    def desk(self) -> RunDesk | SocketDesk:
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
        asked = None if request is None or request.isolation is None else request.isolation
        return RunDesk(run, start_search, None if asked is None else Isolation(asked))

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
    return (folder / MARK).is_file()


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
    link = linked_workspace(folder) if folder.is_dir() else None
    if link is not None:
        if link.run != run:
            of = link.run.name if link.run else "a coding agent"
            raise UserError(f"{folder} is the workspace of {of}; choose another folder")
    # A folder with the mark and no link was made by an older version, or moved.
    elif folder.is_dir() and not is_workspace(folder) and any(folder.iterdir()):
        raise UserError(f"{folder} is not empty: give a new folder")
    if folder == run or run in folder.parents or folder in run.parents:
        raise UserError(
            f"{folder} and the run directory {run}: one contains the other, but a workspace "
            "must not show the ledger; choose another folder"
        )
    started = prepared.started
    write_folder(folder, prepared.problem, started.experiments, run, started.seed, confinement)
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
    python = repr(sys.executable)
    write_file(folder, "plot.py", PLOT.replace("{python}", python))
    names = trajectory_names(problem.train)
    references = problem.loop.reference if problem.loop else ()
    signals = (*problem.inputs, *problem.outputs, *references)
    write_file(folder, "problem.toml", training_text(problem, names))
    if problem.plant is not None:
        (folder / problem.plant.label.partition(":")[0]).write_bytes(problem.plant.code)
    (folder / "data").mkdir(exist_ok=True)
    for number, response in enumerate(problem.responses, 1):
        write_response(folder / "data" / f"response{number}.npz", response)
    write_file(folder, "tools.py", TOOLS.replace("{seed}", str(seed)).replace("{python}", python))
    for name, trajectory in zip(names, problem.train, strict=True):
        # Time first; empty where an output was not measured.
        stream = io.StringIO()
        table = csv.writer(stream, lineterminator="\n")
        table.writerow(["time", *(s.name for s in signals)])
        columns = [trajectory.u, trajectory.measured_y]
        columns += [] if trajectory.reference is None else [trajectory.reference]
        for k in range(len(trajectory)):
            values = [value for part in columns for value in part[k].tolist()]
            row = ("" if math.isnan(value) else repr(value) for value in values)
            table.writerow([repr(k * trajectory.sampling_time), *row])
        write_file(folder, f"data/{name}.csv", stream.getvalue())
    if not os.path.lexists(folder / CANDIDATE):
        write_file(folder, CANDIDATE, problem.baseline or LINEAR)
    write_file(folder, MARK, '{"workspace": true}\n')
    link_workspace(folder, run)


def write_views(folder: Path, view: SearchView, store: Store) -> None:
    """Write results.tsv and search_journal.md, read-only, and the best candidate."""
    texts = {VIEWS[0]: results_table(view), VIEWS[1]: journal(view)}
    if view.best is not None:
        texts["best.py"] = store.text(view.best.source)
    for name, text in texts.items():
        write_file(folder, name, text, mode=0o444)


SCORED = ".asia/scored"
"""File of a workspace: digests of the candidates that its tools scored on the folds of V."""


def scored_locally(folder: Path) -> int:
    """Number of different candidates that the tools of a workspace scored on the folds of V."""
    try:
        return len(set((folder / SCORED).read_text("utf-8").split()))
    except OSError:
        return 0


def trajectory_names(trajectories: tuple[Trajectory, ...]) -> list[str]:
    """File names, one a trajectory, all different."""
    stems = [
        "".join(c if c.isalnum() or c in "-_." else "_" for c in r.name).strip(".") or f"record{i}"
        for i, r in enumerate(trajectories, 1)
    ]
    return [f"{s}-{i}" if stems.count(s) > 1 else s for i, s in enumerate(stems, 1)]
