"""A comparison as JSON, for scripts."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from asia.bench._bench import BenchResult
from asia.bench._rows import Comparison
from asia.bench._test import test_object


def result_object(result: BenchResult) -> dict[str, Any]:
    """`comparisons` holds one object an early-stopping setting, never both in one; `test` is null
    while the declared run is sealed."""
    return {
        "comparisons": [_comparison(c) for c in result.comparisons],
        "declared": result.declared,
        "test": test_object(result.test) if result.test else None,
        "document": str(result.document),
        "pictures": [str(path) for path in result.pictures],
    }


def _comparison(comparison: Comparison) -> dict[str, Any]:
    return {
        "early_stopping": comparison.setting,
        "rows": [{**asdict(row), "V": row.median} for row in comparison.rows],
        "reached": [
            {"control": r.control, "seeds": list(r.seeds), "experiments": list(r.experiments)}
            for r in comparison.reached
        ],
    }
