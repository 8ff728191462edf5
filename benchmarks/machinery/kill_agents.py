"""Kill a search of several coding agents at random moments, and time one agent against several.

python benchmarks/machinery/kill_agents.py [--kills 50] [--agents 3] [--ideas 12] [--think 4]
    [--seed 0] [--out DIR]

Each scripted agent works through the list of ideas from another place on, as a coding agent would:
it leaves out what results.tsv holds, thinks for `--think` seconds, and hands in with `asia try`. It
writes down every answer. So most ideas are handed in by several.

First one agent, then several search undisturbed: the wall time of both. Then the search of several
agents is killed (SIGKILL, the process of the search alone) at random moments and started again,
until the kills are used up; a search that ends before is checked and the next one begun. At its end
each idea must have one result, each answer must be that of the ledger, the records of a kill must
be there, no process may outlive a kill, and `asia verify` and, for the last one, `asia verify
--replay` must pass. Prints a table; exits with 1 on any lost or doubled result.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from asia.ledger.events import SessionStarted
from asia.ledger.run import open_run
from kill_cheap import NAME, arx
from kill_common import ASIA, below, outliving, whole_lines, write_problem

AGENT = """
import subprocess, sys, time
from pathlib import Path

asia, ideas, think, place = sys.argv[1], Path(sys.argv[2]), float(sys.argv[3]), Path("PROMPT.md")
number = place.read_text().partition("You are mine-")[2].partition(".")[0]
every = sorted(ideas.glob("*.txt"))
first = 0 if not number else (int(number) - 1) * len(every) // int(sys.argv[4])
for path in every[first:] + every[:first]:
    if f"\\t{path.stem}\\t" in Path("results.tsv").read_text():
        continue
    time.sleep(think)
    Path("candidate.py").write_text(path.read_text())
    done = subprocess.run(
        [asia, "try", "--json", "-m", path.stem], stdout=subprocess.PIPE, text=True
    )
    with Path("answers.jsonl").open("a") as stream:
        stream.write(done.stdout)
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

    def start(self) -> subprocess.Popen[bytes]:
        """Start the search, or go on with it."""
        tools, opt = self.out / "tools", self.options
        words = [sys.executable, tools / "agent.py", ASIA, tools, opt.think, self.agents]
        command = " ".join((*(shlex.quote(str(word)) for word in words), "{prompt_file}"))
        agent = "command:mine" + (f"*{self.agents}" if self.agents > 1 else "")
        with (self.out / f"{self.name}.log").open("ab") as log:
            return subprocess.Popen(
                [ASIA, "run", str(self.out / "problem"), "--agent", agent, "--name", NAME,
                 "--experiments", str(1 + opt.ideas), "--runs", str(self.runs),
                 "--command", command, "--agent-mount", str(tools)],
                stdin=subprocess.DEVNULL, stdout=log, stderr=log,
            )  # fmt: skip

    def finish(self) -> float:
        """Search to the end; seconds."""
        begin = time.monotonic()
        if self.start().wait() != 0:
            sys.exit(f"asia failed: see {self.out / self.name}.log")
        return time.monotonic() - begin

    def kill(self, after: float) -> str | None:
        """Kill the search after so many seconds; the last record, or None where it had ended."""
        before, process = whole_lines(self.runs), self.start()
        try:
            if process.wait(after) != 0:
                sys.exit(f"asia failed: see {self.out / self.name}.log")
            return None
        except subprocess.TimeoutExpired:
            os.kill(process.pid, signal.SIGSTOP)
            alive = below(process.pid)
            os.kill(process.pid, signal.SIGKILL)
            process.wait()
        self.faults += [f"outlived: {line}" for line in outliving(alive).values()]
        lines = whole_lines(self.runs)
        if lines[: len(before)] != before:
            self.faults.append("records that were on disk at a kill have changed")
        return json.loads(lines[-1])["event"] if lines else "nothing"

    def check(self, *, replay: bool = False) -> None:
        """Count lost and doubled results, and compare the answers with the ledger."""
        run = open_run(self.runs / NAME)
        ideas = {path.stem for path in (self.out / "tools").glob("*.txt")}
        evaluated = Counter(
            e.proposed.title for e in run.view.finished
            if e.number > 1 and e.result and e.result.duplicate_of is None
        )  # fmt: skip
        self.lost += len(ideas - evaluated.keys())
        self.doubled += len(run.view.finished) - 1 - len(evaluated)
        values = {e.number: e.value for e in run.view.finished}
        for path in (self.runs / ".workspaces" / NAME).rglob("answers.jsonl"):
            for line in path.read_text().splitlines():
                answer = json.loads(line)
                self.lost += values.get(answer["experiment"], -1.0) != answer["V"]
        words = [ASIA, "verify", NAME, "--runs", str(self.runs), *(["--replay"] if replay else [])]
        done = subprocess.run(words, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            self.faults.append(f"{' '.join(words[1:3])}: {done.stderr.strip()[-300:]}")


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
            kills[behind or "ended"] += behind is not None
            print(f"kill {kills.total()}: {trial.name} {behind}", file=sys.stderr, flush=True)
        if behind is not None:
            trial.finish()
        trial.check(replay=kills.total() >= options.kills)
    run = open_run(trials[-1].runs / NAME)
    begun = sum(isinstance(line.event, SessionStarted) for line in run.lines)
    for record, times in kills.most_common():
        print(f"killed behind {record:<18}{times:>4}")
    for trial in trials:
        for fault in trial.faults:
            print(f"DIFFERENT  {trial.name}: {fault}")
    lost, doubled = (sum(getattr(t, name) for t in trials) for name in ("lost", "doubled"))
    print(
        f"{kills.total()} kills over {len(trials) - 2} searches of {options.agents} agents and "
        f"{options.ideas} ideas: {lost} lost, {doubled} doubled results; {begun} sessions in the "
        "last search"
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
