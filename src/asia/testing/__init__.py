"""Conformance suites for authors of new parts. Each raises AssertionError that says what fails."""

from asia.testing.agent import check_agent
from asia.testing.candidate import check_candidate
from asia.testing.executor import check_executor
from asia.testing.export_target import check_export_target
from asia.testing.family import check_family
from asia.testing.ledger import OpenLedger, check_ledger, check_sink
from asia.testing.metric import check_metric
from asia.testing.sandbox import OpenWorker, check_sandbox
from asia.testing.source import check_source
from asia.testing.validation_check import check_validation_check

__all__ = [
    "OpenLedger",
    "OpenWorker",
    "check_agent",
    "check_candidate",
    "check_executor",
    "check_export_target",
    "check_family",
    "check_ledger",
    "check_metric",
    "check_sandbox",
    "check_sink",
    "check_source",
    "check_validation_check",
]
