"""Every benchmark that comes with ASIA, searched one after the other, beside its board."""

from asia.bench.suite.plan import SUITE, SuitePlan, select_problems
from asia.bench.suite.run import SuiteResult, SuiteWatcher, bench_suite

__all__ = [
    "SUITE",
    "SuitePlan",
    "SuiteResult",
    "SuiteWatcher",
    "bench_suite",
    "select_problems",
]
