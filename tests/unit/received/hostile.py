"""A hostile run folder: a real search whose candidate leaves marks wherever its code runs, with a
ledger that was written anew to weaken whoever opens it."""

from __future__ import annotations

import os
import shutil
from dataclasses import dataclass, replace
from pathlib import Path

from asia.interfaces.workspace.process import SearchRequest
from asia.interfaces.workspace.workspace import write_folder
from asia.ledger.chain import BEGIN, Chain, encode, read_lines
from asia.ledger.events import Event, Refitted, Started
from asia.problem.load import load_problem
from asia.search.run import prepare, search
from tests.unit.search.toy import Scripted, arx, write_problem

# Each place where code of a candidate can run leaves a mark there, and tries to start a program.
_ESCAPE = """
import os
from pathlib import Path


def _escape(place):
    for folder in ({marks!r}, {home!r}):
        try:
            Path(folder, place).touch()
        except OSError:
            pass
    try:
        os.system("touch " + {marks!r} + "/" + place + "-program")
    except OSError:
        pass


_escape("import")


def _unpickled(weights):
    _escape("unpickle")
    model = Model.__new__(Model)
    model.weights = weights
    return model
"""
AGENT = """
from pathlib import Path

Path({marks!r}, "agent").write_text("ran")


class Hostile:
    name = "scripted"

    def propose(self, view):
        return None
"""


def hostile_source(marks: Path, home: Path) -> str:
    """A candidate with a good score that tries to leave marks at import, at its fit, when its model
    is unpickled, and when it simulates."""
    source = arx(2).replace(
        "    def simulate(self, past_u, past_y, u):\n",
        "    def __reduce__(self):\n        return _unpickled, (self.weights,)\n\n"
        "    @property\n    def estimates(self):\n        _escape('estimates')\n\n"
        "    def simulate(self, past_u, past_y, u):\n        _escape('simulate')\n",
    )
    source = source.replace(
        "def fit(trajectories, context):\n",
        "def fit(trajectories, context):\n    _escape('fit')\n",
    )
    return _ESCAPE.format(marks=str(marks), home=str(home)) + source


@dataclass(frozen=True)
class HostileRun:
    """A received run folder, and where its code would leave marks."""

    directory: Path
    marks: Path
    home: Path
    problem: Path

    @property
    def marked(self) -> list[str]:
        """Marks outside the sandbox."""
        return sorted(path.name for place in (self.marks, self.home) for path in place.iterdir())

    def copy(self, runs: Path) -> HostileRun:
        """A copy to be opened by one command."""
        shutil.copytree(self.directory.parent, runs)
        return replace(self, directory=runs / self.directory.name)


def make_hostile_run(root: Path) -> HostileRun:
    """Search with the hostile candidate in the sandbox, then forge the ledger: level `process`, an
    agent class in the current folder, and a token for the pages."""
    marks, home = root / "marks", root / "victim"
    marks.mkdir(parents=True)
    home.mkdir()
    problem = write_problem(root / "toy")
    loaded = load_problem(problem)
    budget = replace(loaded.budget, experiments=2)
    agent = Scripted((hostile_source(marks, home),))
    ready = prepare(
        replace(loaded, budget=budget), agent.name, seed=0, runs=root / "runs", name="gift"
    )
    view = search(ready, agent, lambda event, view: None, lambda view: None)
    assert view.best is not None
    assert view.best.number == 2
    forge(ready.directory, weaken)
    (root / "runs" / ".view-token").write_text("t" * 43)
    return HostileRun(ready.directory, marks, home, problem)


def weaken(event: Event) -> Event:
    """The first event names the weakest level and an agent class."""
    if isinstance(event, Started):
        settings = {"class": "hostile_agent:Hostile"}
        return replace(
            event, isolation="process", layers=(), agent_settings=settings, isolation_notes=()
        )
    if isinstance(event, Refitted):
        return replace(event, use="ensemble")
    return event


def forge(directory: Path, change) -> None:
    """Write a ledger anew with valid hashes, each event changed."""
    path = directory / "ledger.jsonl"
    place, written = BEGIN, b""
    for line in list(read_lines(path)):
        raw = encode(place, change(line.event))
        written += raw
        place = place.behind(raw)
    path.write_bytes(written)
    with Chain(path) as chain:
        assert chain.view.started.isolation == "process"


def plant_agent(folder: Path, marks: Path) -> None:
    """The agent class that the ledger names, and a package that claims to bring parts."""
    (folder / "hostile_agent.py").write_text(AGENT.format(marks=str(marks)))
    facts = folder / "hostile-1.0.dist-info"
    facts.mkdir()
    (facts / "METADATA").write_text("Metadata-Version: 2.1\nName: hostile\nVersion: 1.0\n")
    (facts / "entry_points.txt").write_text(
        "[asia.agents]\nhostile = hostile_agent:Hostile\n"
        "[asia.commands]\nstatus = hostile_agent:Hostile\n"
    )


MARK = """
from pathlib import Path

Path({marks!r}, "module").touch()
"""
MODULES = (
    "sitecustomize", "usercustomize", "conftest", "numpy", "json", "asia", "candidate", "plant",
    "controller", "cards", "landlock", "seccomp", "__main__",
)  # fmt: skip


def plant_modules(folder: Path, marks: Path) -> None:
    """Files that Python or a tool imports by themselves, and files named like modules; an artifact
    that leaves a mark when it is unpickled."""
    for name in MODULES:
        (folder / f"{name}.py").write_text(MARK.format(marks=str(marks)))
    (folder / "model.pkl").write_bytes(
        b"cpathlib\nPath.touch\n(cpathlib\nPath\n(V" + f"{marks}/pickle".encode() + b"\ntRtR."
    )


def name_code(problem: Path, folder: Path) -> None:
    """A copy of a problem whose file names code wherever text names something."""
    shutil.copytree(problem, folder)
    text = (folder / "problem.toml").read_text()
    loop = '[loop]\nreference = "r"\ncontroller = "controller:function"\n'
    (folder / "problem.toml").write_text(f"{text}{loop}")


def name_code_in_run(run: Path) -> None:
    """The lock of a run, and what its user asked of a search, name code; a candidate waits."""
    lock = run / "problem.lock.toml"
    lock.write_text(f'{lock.read_text()}[loop]\nreference = "u"\ncontroller = "controller:run"\n')
    ask_for_more(run)


def ask_for_more(run: Path) -> None:
    """The request of a run names an agent class and the weakest level."""
    request = SearchRequest(
        problem="named", agent="hostile_agent:Hostile", experiments=4, isolation="process",
        settings={"class": "hostile_agent:Hostile"},
    )  # fmt: skip
    request.save(run)
    (run / "control" / "queue").mkdir(exist_ok=True)
    for name in ("1.json", "1.py", "note-1.txt"):
        (run / "control" / "queue" / name).write_text("import controller")


def plant_all(here: Path, received: HostileRun) -> HostileRun:
    """A copy of the run in `runs`, problems in `named`, `problem` and the folder itself, and files
    named like modules everywhere."""
    here.mkdir(exist_ok=True)
    plant_agent(here, received.marks)
    shutil.copytree(received.problem, here / "problem")
    name_code(received.problem, here / "named")
    shutil.copytree(here / "named", here, dirs_exist_ok=True)
    copy = received.copy(here / "runs")
    for folder in (here, here / "named", here / "problem", copy.directory):
        plant_modules(folder, received.marks)
    plant_modules(copy.directory / "artifacts", received.marks)
    ask_for_more(copy.directory)
    return copy


def make_hostile_workspace(root: Path, received: HostileRun) -> Path:
    """A workspace after its agent: each of its files carries code or names code, and links and
    pipes lie beside them."""
    outside = root / "outside"
    outside.mkdir()
    (outside / "notes").write_text("the-secret of the user")
    made = root / "work"
    own = received.copy(root / "runs")
    write_folder(made, load_problem(received.problem), 2, own.directory)
    plant_all(made, received)
    source = hostile_source(received.marks, received.home)
    for name in ("candidate.py", "best.py"):
        (made / name).write_text(source)
    for name in ("tools.py", "plot.py"):
        (made / name).write_text(MARK.format(marks=str(received.marks)))
    for name in ("models.md", "description.md"):
        (made / name).unlink()
        (made / name).symlink_to(outside / "notes")
    (made / "PROGRAM.md").unlink()
    os.mkfifo(made / "PROGRAM.md")
    os.mkfifo(made / "data" / "pipe.csv")
    (made / "link").symlink_to(outside)
    return made
