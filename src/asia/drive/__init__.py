"""Drivers from outside: a desk where candidates are handed in, and who hands them in."""

from asia.drive._desk import Desk, Job, Result, RunDesk, Standing, wait
from asia.drive._detached import Order, start_search
from asia.drive._serve import prepare_order
from asia.drive._workspace import CANDIDATE, Workspace, make_workspace

__all__ = [
    "CANDIDATE",
    "Desk",
    "Job",
    "Order",
    "Result",
    "RunDesk",
    "Standing",
    "Workspace",
    "make_workspace",
    "prepare_order",
    "start_search",
    "wait",
]
