"""Small language models that choose from a menu, against random, the expert and two controls.

The controls show what the menu gives without a model: always its first candidate, or any with equal
chance. Each model makes the first search twice; the sources, scores and requests must be the same.
Resumes. Nothing here opens a test.

    python benchmarks/searches/menu.py MODEL.gguf... --seeds 0 1 2 --runs runs
"""

from __future__ import annotations

import hashlib
import json
import statistics
from collections import Counter
from dataclasses import replace
from datetime import datetime
from functools import partial
from pathlib import Path

from asia.agents import Agent, AgentView, Proposal, make_agent
from asia.agents.llm.agent import LlmAgent
from asia.agents.llm.local import LocalServer
from asia.agents.llm.menu import menu
from asia.agents.llm.reply import Answer, Choice, read_answer, read_choice
from asia.agents.llm.settings import LlmSettings
from asia.ledger.events import Evaluated, Proposed
from asia.ledger.run import Run, open_run
from asia.problem.load import load_problem
from asia.search.run import prepare, search
from harness import number, option_parser, table


class MenuControl:
    """Agent that chooses from the menu without a model."""

    def __init__(self, name: str, seed: int) -> None:
        self.name, self._seed = name, seed

    def propose(self, view: AgentView) -> Proposal | None:
        """The first candidate, or one with equal chance; None where the menu is empty."""
        offers = menu(view)
        if not offers:
            return None
        word = f"{self._seed}:{len(view.proposed)}"
        drawn = int.from_bytes(hashlib.sha256(word.encode()).digest()[:8], "big") % len(offers)
        place = 0 if self.name == "menu-first" else drawn
        return offers[place].chosen(Choice(place + 1, {}, "control"))


def model_agent(weights: Path, seed: int) -> Agent:
    """A model in menu mode with its own server."""
    server = LocalServer(weights, context=8192)
    settings = LlmSettings(
        weights.stem, server.url, seed=seed, proposals="menu", local=server.facts
    )
    return LlmAgent(settings, server=server)


def answers(run: Run) -> list[Answer]:
    """Answers of the model, repaired ones too."""
    return [read_answer(run.store.get(e.response)) for e in run.view.exchanges if e.status == 200]


def content(run: Run) -> str:
    """Everything in a run that a repetition must give again: requests, answers, candidates with
    their rationale, outcomes and scores, without times."""
    asked = [run.store.get(e.request).decode() for e in run.view.exchanges]
    proposed = [
        (e.proposed.digest, e.proposed.family, e.proposed.title, e.proposed.hypothesis,
         e.proposed.parent, e.result and e.result.status,
         e.score and (e.score.value.hex(), [f.value.hex() for f in e.score.folds]))
        for e in run.view.finished
    ]  # fmt: skip
    text = json.dumps([asked, [a.text for a in answers(run)], proposed])
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def seconds_a_step(run: Run) -> float:
    """Median time from a result to the next proposal."""
    waits: list[float] = []
    done: datetime | None = None
    for line in run.lines:
        at = datetime.fromisoformat(line.time)
        if isinstance(line.event, Evaluated):
            done = at
        elif isinstance(line.event, Proposed) and done is not None:
            waits.append((at - done).total_seconds())
            done = None
    return statistics.median(waits)


def main() -> None:
    """Run the searches that are not there yet and print the tables."""
    parser = option_parser(__doc__)
    parser.add_argument("models", nargs="*", type=Path, help="GGUF files")
    parser.add_argument("--problem", default="two_tanks_sim")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--experiments", type=int, default=10)
    parser.add_argument("--runs", type=Path, default=Path("runs"))
    options = parser.parse_args()
    problem = load_problem(options.problem)
    budget = replace(
        problem.budget, experiments=options.experiments, patience=10 * options.experiments
    )
    problem = replace(problem, budget=budget)

    def searched(label: str, seed: int, again: str = "") -> Run:
        name = f"{options.problem}-{label}-s{seed}{again}"
        found = open_run(options.runs / name) if (options.runs / name).is_dir() else None
        if found is None or not found.view.complete:
            agent = makers[label](seed)
            settings = agent.recorded() if isinstance(agent, LlmAgent) else {}
            ready = prepare(
                problem, agent.name, seed=seed, runs=options.runs, name=name,
                agent_settings=settings,
            )  # fmt: skip
            search(ready, agent, lambda *_: None, lambda _: None)
            found = open_run(options.runs / name)
        return found

    makers = {
        "expert": lambda _: make_agent("expert"),
        "random": lambda _: make_agent("random"),
        "menu-first": partial(MenuControl, "menu-first"),
        "menu-any": partial(MenuControl, "menu-any"),
        **{path.stem: partial(model_agent, path) for path in options.models},
    }
    rows: list[list[str]] = []
    places: list[list[str]] = []
    for label in makers:
        runs = [searched(label, seed) for seed in options.seeds]
        values = [r.view.best.score.value for r in runs if r.view.best and r.view.best.score]
        usages = [e.usage for r in runs for e in r.view.exchanges if e.usage is not None]
        steps = sum(len(r.view.finished) - 1 for r in runs)
        tokens = sum(u.tokens for u in usages) / steps
        rows.append([
            label, *map(number, values), number(statistics.mean(values)),
            f"{tokens:.0f}" if usages else "-",
            f"{statistics.median(map(seconds_a_step, runs)):.1f}",
        ])  # fmt: skip
        print(" | ".join(rows[-1]), flush=True)
    seeds = [f"V, seed {seed}" for seed in options.seeds]
    print(f"\n{options.problem}, {options.experiments} experiments\n")
    print(table(["agent", *seeds, "mean", "tokens a step", "s to propose"], rows))
    # Last, because a table of all agents needs no repetition.
    for label in (path.stem for path in options.models):
        runs = [searched(label, seed) for seed in options.seeds]
        same = content(runs[0]) == content(searched(label, options.seeds[0], "-again"))
        chosen = [read_choice(a.text) for r in runs for a in answers(r)]
        counts = Counter(c.number for c in chosen if c is not None)
        reasons = {c.reason for c in chosen if c is not None}
        places.append([
            label, "yes" if same else "NO", str(len(chosen)), str(len(chosen) - counts.total()),
            ", ".join(f"{n}: {counts[n]}" for n in sorted(counts)),
            str(sum(bool(c.settings) for c in chosen if c is not None)), str(len(reasons)),
        ])  # fmt: skip
    heads = ["model", "repeated the same", "answers", "not usable", "number chosen: times"]
    print("\n" + table([*heads, "with settings", "distinct reasons"], places))


if __name__ == "__main__":
    main()
