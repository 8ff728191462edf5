"""ASIA: the Autonomous System Identification Agent.

    import asia
    run = asia.run("two_tanks_sim", experiments=8)
    print(run.view.best)

Names load what they need when they are first used: a sandboxed worker imports this package too.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from asia._api import run
    from asia.candidate import Context, Model
    from asia.data.trajectory import Signal, Trajectory
    from asia.export.linear import linearize
    from asia.interfaces.python import SystemIdentifier, load_run
    from asia.ledger.run import open_run
    from asia.problem.load import load_problem
    from asia.problem.problem import Problem
    from asia.report.files import write_report
    from asia.search.simulation import simulate
    from asia.search.unsealing import unseal

__version__ = "0.1.0"

__all__ = [
    "Context",
    "Model",
    "Problem",
    "Signal",
    "SystemIdentifier",
    "Trajectory",
    "linearize",
    "load_problem",
    "load_run",
    "open_run",
    "run",
    "simulate",
    "unseal",
    "write_report",
]

_HOMES = {
    "Context": "asia.candidate",
    "Model": "asia.candidate",
    "Problem": "asia.problem.problem",
    "Signal": "asia.data.trajectory",
    "SystemIdentifier": "asia.interfaces.python",
    "Trajectory": "asia.data.trajectory",
    "linearize": "asia.export.linear",
    "load_problem": "asia.problem.load",
    "load_run": "asia.interfaces.python",
    "open_run": "asia.ledger.run",
    "run": "asia._api",
    "simulate": "asia.search.simulation",
    "unseal": "asia.search.unsealing",
    "write_report": "asia.report.files",
}


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module 'asia' has no attribute '{name}'")
    from importlib import import_module

    return getattr(import_module(_HOMES[name]), name)
