"""Kill a search of several coding agents at random moments, and time one agent against several.

python benchmarks/machinery/kill_agents.py [--kills 50] [--agents 3] [--ideas 12] [--think 4]
    [--seed 0] [--out DIR]

Each scripted agent works through the list of ideas from another place on, as a coding agent would:
it leaves out what results.tsv holds, thinks for `--think` seconds, hands in through its socket,
waits for the result and writes it down. Fits cost milliseconds. So most ideas are handed in by
several.

First one agent, then several search undisturbed: the wall time of both. Then the search of several
agents is killed (SIGKILL, the process of the search alone) at random moments and started again,
until the kills are used up; a search that ends before is checked and the next one begun. At its end
each idea must have one result, each answer must be that of the ledger, the records of a kill must
be there, no process may outlive a kill, and the last ledger must replay bitwise. Prints a table;
exits with 1 on any lost or doubled result.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from asia.interfaces.coding_agents.presets import Preset
from asia.interfaces.coding_agents.session import (
    CommandRules,
    command_agent,
    search_with_process,
)
from asia.judge.sandbox.jail import Jail
from asia.ledger.run import open_run
from asia.problem.load import load_problem
from asia.search.replay import replay_run
from asia.search.run import Prepared, prepare
from kill_cheap import NAME, arx
from kill_common import below, outliving, whole_lines, write_problem

AGENT = """
import json, os, socket, sys, time
from pathlib import Path


def ask(**request):
    with socket.socket(socket.AF_UNIX) as channel:
        channel.connect(os.environ["ASIA_DESK"])
        channel.sendall(json.dumps(request).encode() + b"\\n")
        answer = json.loads(channel.makefile("rb").readline())
    if "error" in answer:
        sys.exit(answer["error"])
    return answer["ok"]


tools, think, agents = Path(sys.argv[1]), float(sys.argv[2]), int(sys.argv[3])
number = Path("PROMPT.md").read_text().partition("You are mine-")[2].partition(".")[0] or "1"
every = sorted(tools.glob("*.txt"))
first = (int(number) - 1) * len(every) // agents
for path in every[first:] + every[:first]:
    if f"\\t{path.stem}\\t" in Path("results.tsv").read_text():
        continue
    time.sleep(think)
    found = ask(op="submit", source=path.read_text(), hypothesis=path.stem)
    while found["state"] != "done":
        time.sleep(0.05)
        found = ask(op="submission", ticket=found["ticket"])
    result = next(r for r in ask(op="results") if r["experiment"] == found["experiment"])
    with Path("answers.jsonl").open("a") as stream:
        print(json.dumps([path.stem, found["experiment"], result["V"]]), file=stream)
"""


@dataclass
class Trial:
    """One search of scripted agents, from its start to its end."""

    out: Path
    options: argparse.Namespace
    agents: int
    name: str
    lost: int = 0
    doubled: int = 0
    faults: list[str] = field(default_factory=list)

    @property
    def runs(self) -> Path:
        """Folder of its run."""
        return self.out / self.name

    def start(self) -> int:
        """Start the search in a process of its own, or go on with it; its pid."""
        pid = os.fork()
        if pid:
            return pid
        code = 1
        try:
            log = os.open(self.out / f"{self.name}.log", os.O_WRONLY | os.O_CREAT | os.O_APPEND)
            os.dup2(log, 1)
            os.dup2(log, 2)
            self._search()
            code = 0
        except BaseException:  # noqa: BLE001 - the border of the process
            traceback.print_exc()
            sys.stderr.flush()
        os._exit(code)

    def prepare(self) -> Prepared:
        """Prepare the search. Its modules are then loaded for the processes to come."""
        problem, opt = load_problem(str(self.out / "problem")), self.options
        budget = replace(problem.budget, patience=10_000, experiments=1 + opt.ideas, retests=0)
        wanted = replace(problem, budget=budget)
        return prepare(wanted, "mine", seed=opt.seed, runs=self.runs, name=NAME)

    def _search(self) -> None:
        opt, tools, ready = self.options, self.out / "tools", self.prepare()
        words = (sys.executable, tools / "agent.py", tools, opt.think, self.agents, "{prompt_file}")
        rules = CommandRules(mounts=(tools,), jail=Jail.why_not() is None)
        names = tuple(f"mine-{k + 1}" for k in range(self.agents)) if self.agents > 1 else ("",)
        agent = command_agent(ready, Preset(tuple(map(str, words))), rules, names)
        search_with_process(ready, agent, agent, lambda event, view: None, lambda view: None)

    def _wait(self, pid: int, seconds: float = float("inf")) -> bool:
        """Wait for its end, and return whether it ended."""
        end = time.monotonic() + seconds
        while (found := os.waitpid(pid, os.WNOHANG)) == (0, 0):
            if time.monotonic() > end:
                return False
            time.sleep(0.01)
        if found[1] != 0:
            sys.exit(f"the search failed: see {self.out / self.name}.log")
        return True

    def finish(self) -> float:
        """Search to the end; seconds."""
        begin = time.monotonic()
        self._wait(self.start())
        return time.monotonic() - begin

    def kill(self, after: float) -> str | None:
        """Kill the search after so many seconds; the last record, or None where it had ended."""
        before, pid = whole_lines(self.runs), self.start()
        if self._wait(pid, after):
            return None
        os.kill(pid, signal.SIGSTOP)
        alive = below(pid)
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)
        self.faults += [f"outlived: {line}" for line in outliving(alive).values()]
        lines = whole_lines(self.runs)
        if lines[: len(before)] != before:
            self.faults.append("records that were on disk at a kill have changed")
        return json.loads(lines[-1])["event"] if lines else "nothing"

    def check(self) -> None:
        """Count lost and doubled results, and compare the answers with the ledger."""
        finished = open_run(self.runs / NAME).view.finished
        evaluated = Counter(e.proposed.title for e in finished if e.number > 1)
        ideas = {path.stem for path in (self.out / "tools").glob("*.txt")}
        self.lost += len(ideas - evaluated.keys())
        self.doubled += len(finished) - 1 - len(evaluated)
        results = {(e.proposed.title, e.number, e.value) for e in finished}
        for path in (self.runs / ".workspaces" / NAME).rglob("answers.jsonl"):
            answers = [tuple(json.loads(line)) for line in path.read_text().splitlines()]
            self.lost += sum(answer not in results for answer in answers)


def main() -> int:
    """Time, kill, check, print; 1 where anything was lost or doubled."""
    options = _options()
    out = Path(options.out or tempfile.mkdtemp(prefix="asia-agents-"))
    write_problem(out / "problem")
    (out / "tools").mkdir()
    (out / "tools" / "agent.py").write_text(AGENT)
    for k in range(options.ideas):
        source = arx(1 + k % 5, k % 2, 10.0 ** (-1 - k // 5))
        (out / "tools" / f"idea{k:02d}.txt").write_text(source)
    one = Trial(out, options, 1, "one")
    one.prepare()
    alone = one.finish()
    several = Trial(out, options, options.agents, "several")
    together = several.finish()
    trials, random, kills = [one, several], np.random.default_rng(options.seed), Counter[str]()
    trials[0].check()
    several.check()
    print(
        f"{options.ideas} ideas, {options.think:g} s of thinking each: 1 agent {alone:.1f} s, "
        f"{options.agents} agents {together:.1f} s ({alone / together:.2f} times), load "
        f"{os.getloadavg()[0]:.1f}; files in {out}",
        flush=True,
    )
    while kills.total() < options.kills:
        trial = Trial(out, options, options.agents, f"killed{len(trials) - 1}")
        trials.append(trial)
        behind: str | None = ""
        while kills.total() < options.kills and behind is not None:
            behind = trial.kill(float(random.uniform(0.0, options.share * together)))
            if behind is not None:
                kills[behind] += 1
                print(f"kill {kills.total()}: {trial.name} {behind}", file=sys.stderr, flush=True)
        if behind is not None:
            trial.finish()
        trial.check()
    last = trials[-1]
    replayed = replay_run(last.runs / NAME, lambda item: None)
    if not all(item.outcome == "same" for item in replayed.items):
        last.faults.append("the ledger does not replay bitwise")
    for record, times in kills.most_common():
        print(f"killed behind {record:<18}{times:>4}")
    for trial in trials:
        for fault in trial.faults:
            print(f"DIFFERENT  {trial.name}: {fault}")
    lost, doubled = (sum(getattr(t, name) for t in trials) for name in ("lost", "doubled"))
    print(
        f"{kills.total()} kills over {len(trials) - 2} searches of {options.agents} agents and "
        f"{options.ideas} ideas: {lost} lost, {doubled} doubled results"
    )
    return 1 if lost or doubled or any(trial.faults for trial in trials) else 0


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--agents", type=int, default=3)
    parser.add_argument("--ideas", type=int, default=12)
    parser.add_argument("--think", type=float, default=4.0, help="seconds before an idea")
    parser.add_argument("--share", type=float, default=0.4,
                        help="a kill falls into this share of an undisturbed search")  # fmt: skip
    parser.add_argument("--seed", type=int, default=0, help="of the moments")
    parser.add_argument("--out", help="an empty directory; default: a temporary one")
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
