"""An agent of rules: it looks at residuals, says what it sees, and changes one thing at a time.

    cd WORKSPACE; python .../residual_agent.py

It has what the folder gives and nothing else: `tools.py` for residuals on the training part of each
fold, `asia try` for the score, `results.tsv`. It starts from the equations of the problem alone.
"""

from __future__ import annotations

import csv
import importlib
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from asia.interfaces.workspace.tools import Fitted, WorkspaceTools
from asia.judge.scoring.residuals import PartKind, cross_correlation, independent_band
from asia.problem.folds import Fold, whole
from asia.problem.protocol import ProtocolRule

TRIES = 6
LAGS = 40
CANDIDATE = '''"""{words}"""

from asia.models import greybox
from asia.models.methods import LevenbergMarquardt

CONFIG = greybox.Config({config})
METHOD = LevenbergMarquardt(iterations=60, starts=4{method})


def fit(trajectories, context):
    return greybox.train(greybox.build(CONFIG, context), trajectories, context, METHOD)
'''


@dataclass(frozen=True)
class Evidence:
    """Findings from the residuals of one fold, on its training records."""

    along_output: float
    """Share of the squared residual that is a function of the simulated output."""
    with_input: float
    """Largest correlation with an input up to 40 samples before, over its 99 % band."""
    memory: float
    """Correlation with the residual 5 samples before."""

    def __str__(self) -> str:
        return (
            f"along the output {self.along_output:.2f}, with the input {self.with_input:.2f} of "
            f"the band, own past {self.memory:.2f}"
        )


@dataclass(frozen=True)
class Settings:
    """Arguments of the candidate, as source."""

    config: tuple[str, ...] = ()
    """Options of `greybox.Config`."""
    method: tuple[str, ...] = ()
    """Options of the method that fits it, beside its iterations and starts."""

    def source(self, words: str) -> str:
        """The candidate."""
        method = "".join(f", {one}" for one in self.method)
        return CANDIDATE.format(words=words, config=", ".join(self.config), method=method)


@dataclass(frozen=True)
class Move:
    """One change."""

    words: str
    """Text of the change."""
    config: tuple[str, ...] = ()
    """Arguments to add to `greybox.Config`."""
    method: tuple[str, ...] = ()
    """Arguments to add to the method."""

    def applied(self, settings: Settings) -> Settings:
        """With this change."""
        return replace(
            settings,
            config=settings.config + self.config,
            method=settings.method + self.method,
        )


@dataclass(frozen=True)
class Rule:
    """Reaction to a finding in the residuals."""

    seen: str
    """Text of the finding."""
    shown: Callable[[Evidence], bool]
    """Whether they show it, in the mean over the folds."""
    moves: tuple[Move, ...]
    """Changes, the first one first."""
    factor: float
    """A move is kept where V falls below this factor of the best V."""


def rules(tools: WorkspaceTools) -> tuple[Rule, ...]:
    """The rules, the first one first: what bends the output also correlates with the input, and
    both give the residual a memory."""
    inputs = [signal.name for signal in tools.problem.inputs]
    states = tools.problem.physics.states if tools.problem.physics else ()
    late = tuple(
        Move(f"{name} acts through a lag", (f"lag=({name!r},)",))
        for name in (*inputs, *states[:-1])
    )
    weak = Move("additions are held at no effect less firmly", ("ridge=1e-8",))
    return (
        Rule(
            "half of the squared residual or more is a curve over the simulated output: the sensor "
            "may be bent",
            lambda e: e.along_output > 0.5,
            (Move("the sensor follows a power of the level", ('sensor="power"',)),),
            0.9,
        ),
        Rule(
            "the residual follows the input, and is no curve over the output: the equations may "
            "answer too early",
            lambda e: e.with_input > 1.0 and e.along_output <= 0.5,
            (late[0], weak, *late[1:]),
            0.9,
        ),
        Rule(
            "the residual remembers itself and follows neither output nor input: a slow "
            "disturbance",
            lambda e: e.memory > 0.4 and e.with_input <= 1.0 and e.along_output <= 0.5,
            (Move("the residual is slow plus white noise", (), ('noise_model="slow"',)),),
            1.02,
        ),
    )


def look(fold: Fold, found: Fitted, rule: ProtocolRule) -> Evidence:
    """The evidence of a fold; of several outputs and inputs the worst."""
    shares: dict[int, float] = {}
    record, fit = found
    for one in record.residuals:
        if one.kind is PartKind.OUTPUT:
            shares[one.output] = shares.get(one.output, 0.0) + one.share
    follows, memory = [0.0], [0.0]
    pairs = list(zip(whole(fold.train, rule), fit.train_y_hat, strict=True))
    for k in range(pairs[0][1].shape[1]):
        e = [block.y[:, k] - y_hat[:, k] for block, y_hat in pairs]
        memory.append(float(cross_correlation(e, e, 5)[-1]))
        for i in range(pairs[0][0].u.shape[1]):
            u = [block.u[:, i] for block, _ in pairs]
            largest = float(np.abs(cross_correlation(e, u, LAGS)[LAGS:]).max())
            follows.append(largest / independent_band(e, u, 2 * LAGS))
    return Evidence(max(shares.values(), default=0.0), max(follows), max(memory))


def submitted(words: str, parent: int | None) -> tuple[int, float]:
    """`asia try`, its output printed; number and V of the experiment, from results.tsv."""
    command = ["asia", "try", "-m", words, *(["--parent", str(parent)] if parent else [])]
    print("$ " + " ".join(f'"{w}"' if " " in w else w for w in command), flush=True)
    program = str(Path(sys.executable).parent / command[0])
    done = subprocess.run([program, *command[1:]], stdout=subprocess.PIPE, text=True, check=False)
    print(done.stdout, flush=True)
    with Path("results.tsv").open(newline="") as stream:
        *_, last = csv.reader(stream, delimiter="\t")
    return int(last[0]), float(last[1]) if last[1] else float("inf")


def search(tools: WorkspaceTools) -> Settings:
    """Try, look, change, until nothing is seen or the tries are spent; the settings that stay."""
    best, known = Settings(), rules(tools)
    number, value = handed_in(best, "the equations as they are given", None)
    tried: set[Move] = set()
    for _ in range(TRIES - 1):
        pairs = zip(tools.folds, tools.evaluate("candidate.py"), strict=True)
        each = [look(fold, found, tools.rule) for fold, found in pairs]
        for fold, seen in zip(tools.folds, each, strict=True):
            print(f"fold {fold.index + 1}: {seen}")
        due = next_move(known, mean_of(each), tried)
        if due is None:
            print("no rule applies to the residuals any more: I stop here\n")
            break
        rule, move = due
        tried.add(move)
        print(f"I see: {rule.seen}\nI try: {move.words}\n", flush=True)
        changed = move.applied(best)
        new, found = handed_in(changed, f"{rule.seen}. {move.words}", number)
        if found < rule.factor * value:
            best, number, value = changed, new, found
            print("I keep it\n")
        else:
            print(f"V does not fall below {rule.factor:g} times the best: I take it back\n")
            Path("candidate.py").write_text(best.source("the best so far"))
    noise = ", ".join(best.method) or "white noise"
    print(f"result: greybox.Config({', '.join(best.config)}), {noise}")
    return best


def next_move(
    known: Sequence[Rule], evidence: Evidence, tried: set[Move]
) -> tuple[Rule, Move] | None:
    """The first rule that applies, and its first move that was not tried."""
    for rule in known:
        left = [move for move in rule.moves if move not in tried]
        if left and rule.shown(evidence):
            return rule, left[0]
    return None


def mean_of(each: Sequence[Evidence]) -> Evidence:
    """Over the folds."""
    return Evidence(
        float(np.mean([one.along_output for one in each])),
        float(np.mean([one.with_input for one in each])),
        float(np.mean([one.memory for one in each])),
    )


def handed_in(settings: Settings, words: str, parent: int | None) -> tuple[int, float]:
    """Write the candidate and submit it."""
    Path("candidate.py").write_text(settings.source(words))
    return submitted(words, parent)


if __name__ == "__main__":
    sys.path.insert(0, str(Path.cwd()))
    own: Any = importlib.import_module("tools")
    search(own.TOOLS)
