"""Benchmarks of nonlinearbenchmark.org, read from the files that their authors published."""

from asia.data.sources.official.benchmark import OfficialBenchmark
from asia.data.sources.official.layouts import LAYOUTS, BenchmarkLayout

__all__ = ["LAYOUTS", "BenchmarkLayout", "OfficialBenchmark"]
