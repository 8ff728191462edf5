"""Conformance suites for those who add a part. Each raises AssertionError that says what fails."""

from asia.testing._agent import check_agent

__all__ = ["check_agent"]
