"""Write the ledgers that every later version must read: python -m tests.golden.make_ledgers DIR.

DIR is where the runs and their problem appear, and becomes part of their locks; copy `problem` and
`runs` from there into a folder of this one that is named after the version. Nothing in it is ever
written again.
"""

from __future__ import annotations

import json
import os
import platform
import shutil
import sys
from pathlib import Path

import asia
from asia.agents.llm.agent import LlmAgent
from asia.agents.llm.settings import LlmSettings
from asia.judge.evaluation import references
from asia.judge.sandbox.types import Isolation
from asia.ledger.run import Run, open_run
from asia.problem.load import load_problem
from asia.search.run import prepare, search
from asia.search.steering import Steering
from asia.search.unsealing import unseal
from tests.unit.agents.fake_llm import fake_llm, said
from tests.unit.search.toy import CRASH, Scripted, arx, write_problem

AGENT = Scripted((arx(2), CRASH, arx(3)))
NOTE = "Try a slower pole: τ is about 3 s."


def main(root: Path) -> None:
    """Finished, interrupted in the middle of a record, unsealed, and steered with a model."""
    references.LINEAR = arx(2)
    platform.platform = lambda *_: "Linux"
    problem = write_problem(root / "problem")
    runs = root / "runs"
    ready = prepare(
        load_problem(problem),
        AGENT.name,
        seed=0,
        runs=runs,
        name="finished",
        isolation=Isolation.PROCESS,
    )
    search(ready, AGENT, lambda event, view: None, lambda view: None)
    for name in ("interrupted", "unsealed"):
        shutil.copytree(ready.directory, runs / name)
    _cut(runs / "interrupted")
    unseal(runs / "unsealed", process_consent=True)
    _steered(problem, runs)
    for directory in sorted(runs.iterdir()):
        for generated in ("results.tsv", "search_journal.md", "control", "report"):
            path = directory / generated
            shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
        text = json.dumps(recorded(open_run(directory)), indent=1, ensure_ascii=False)
        (directory / "recorded.json").write_text(text + "\n")


def _cut(directory: Path) -> None:
    """As a power cut leaves it: the result of experiment 3 is torn."""
    ledger = directory / "ledger.jsonl"
    lines = ledger.read_bytes().splitlines(keepends=True)
    place = next(n for n, line in enumerate(lines) if b'"experiment":3,"status"' in line)
    ledger.write_bytes(b"".join(lines[:place]) + lines[place][:100])
    named = ledger.read_text()
    for artifact in (directory / "artifacts").iterdir():
        if artifact.name not in named:
            artifact.unlink()


def _steered(problem: Path, runs: Path) -> None:
    os.environ["MADE_UP_KEY"] = "made-up"
    with fake_llm([said(arx(2), family="arx"), said("no code")]) as server:
        Steering(runs / "steered").steer(NOTE)
        agent = LlmAgent(LlmSettings("made-up", server.url, api_key_env="MADE_UP_KEY"))
        asia.run(problem, agent=agent, runs=runs, name="steered", experiments=2)


def recorded(run: Run) -> dict[str, object]:
    """Return the content of a record in plain values."""
    view = run.view
    usage = view.usage
    unsealed = view.unsealed
    ensemble = getattr(unsealed and unsealed.ensemble, "scores", ())
    return {
        "records": len(run.lines),
        "state": run.state,
        "problem": view.started.problem,
        "agent": view.started.agent,
        "budget": view.budget,
        "rungs": {r.name: getattr(r.outcome, "value", None) for r in view.references},
        "notes": [note.text for note in view.notes],
        "tokens": usage.tokens if usage else None,
        "experiments": [
            {
                "number": e.number,
                "title": e.proposed.title,
                "lines": run.store.text(e.proposed.source).count("\n"),
                "status": e.result.status if e.result else None,
                "V": e.score.value if e.score else None,
                "failure": e.failure.reason.value if e.failure else None,
            }
            for e in view.experiments
        ],
        "best": view.best.number if view.best else None,
        "stopped": view.stopped.reason if view.stopped else None,
        "refitted": view.refitted is not None,
        "test": [[s.metric, s.value] for s in ensemble],
    }


if __name__ == "__main__":
    main(Path(sys.argv[1]))
