"""Conformance suites for authors of new parts. Each raises AssertionError that says what fails."""

from asia.testing._agent import check_agent
from asia.testing._candidate import check_candidate
from asia.testing._executor import check_executor
from asia.testing._export_target import check_export_target
from asia.testing._family import check_family
from asia.testing._ledger import OpenLedger, check_ledger
from asia.testing._metric import check_metric
from asia.testing._sandbox import OpenWorker, check_sandbox
from asia.testing._sink import check_sink
from asia.testing._source import check_source
from asia.testing._validation_check import check_validation_check

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
