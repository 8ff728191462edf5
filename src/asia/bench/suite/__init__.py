"""Suite of all benchmarks in ASIA, searched sequentially and compared with their leaderboards."""

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
