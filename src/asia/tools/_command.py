"""`python tools.py`: what it takes, and what it prints."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from dataclasses import replace
from typing import NoReturn

from asia._text import say
from asia.errors import CandidateError, UserError
from asia.protocol import Fold
from asia.sandbox import REPEATABLE
from asia.tools._pictures import draw
from asia.tools._tables import tables
from asia.tools._workspace import WorkspaceTools

_BAD = 2


def main(tools: WorkspaceTools) -> NoReturn:
    """Read the command line, fit and score, print. The process starts itself again where its
    environment is not that of a worker."""
    options = _parser().parse_args()
    if any(os.environ.get(name) != value for name, value in REPEATABLE.items()):
        sys.stdout.flush()
        os.execve(sys.executable, sys.orig_argv, {**os.environ, **REPEATABLE})
    try:
        _run(tools, options)
    except UserError as error:
        sys.exit(_complain(str(error)))
    except CandidateError as error:
        sys.exit(_complain(f"{error.reason.advice} ({error.detail})"))
    sys.exit(0)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="tools.py", description="Score a candidate on training folds, as the evaluator does."
    )
    add = parser.add_argument
    add("candidate", nargs="?", default="candidate.py", help="the file to score")
    add("--seed", type=int, help="seeds of the fits; several show the spread of V")
    add("--fold", type=int, help="this fold alone, from 1")
    add("--blocks", type=int, help="folds of your own: number of parts of each record")
    add("--gap", type=int, default=0, help="samples next to a part that are not used for training")
    add("--hold-out", metavar="NAMES", help="a fold of your own: hold these records out (A,B)")
    add("--held-out", action="store_true", help="residuals of the held-out part as well")
    add("--plot", action="store_true", help="draw simulation and residuals into plots/")
    return parser


def _run(tools: WorkspaceTools, options: argparse.Namespace) -> None:
    if options.seed is not None:
        tools = replace(tools, seed=options.seed)
    folds = _folds(tools, options)
    own = options.blocks is not None or options.hold_out is not None
    found = tools.evaluate(options.candidate, folds)
    whole = not own and len(found) == len(tools.folds)
    held_out = options.held_out or tools.rule.residuals == "held_out"
    for line in tables(tools.problem, found, whole=whole, held_out=held_out):
        say(line)
    if options.plot:
        title = str(options.candidate)
        for name in draw(tools.folder, tools.problem, title, found, held_out=held_out):
            say(f"picture {name}")


def _folds(tools: WorkspaceTools, options: argparse.Namespace) -> Sequence[Fold]:
    if options.blocks is not None:
        folds: Sequence[Fold] = tools.blocks(options.blocks, options.gap)
    elif options.hold_out is not None:
        folds = tools.hold_out(options.hold_out.split(","))
    else:
        folds = tools.folds
    if options.fold is None:
        return folds
    if not 1 <= options.fold <= len(folds):
        raise UserError(f"there is no fold {options.fold}: expected 1 to {len(folds)}")
    return folds[options.fold - 1 : options.fold]


def _complain(message: str) -> int:
    say(f"tools.py: {message}", file=sys.stderr)
    return _BAD
