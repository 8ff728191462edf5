"""System identification from arrays: what a notebook needs, in one object and one table."""

from asia.identifier._frame import load_run
from asia.identifier._identifier import SystemIdentifier

__all__ = ["SystemIdentifier", "load_run"]
