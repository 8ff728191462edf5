"""A comparison as JSON, for scripts."""

from __future__ import annotations

from typing import Any

from asia.bench._bench import BenchResult
from asia.bench._rows import Comparison, Row
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
        "rows": [_row(row) for row in comparison.rows],
        "reached": [
            {
                "control": reached.control,
                "seeds": list(reached.seeds),
                "experiments": list(reached.experiments),
            }
            for reached in comparison.reached
        ],
    }


def _row(row: Row) -> dict[str, Any]:
    return {
        "key": row.key,
        "model": row.model,
        "V": row.median,
        "values": list(row.values),
        "runs": row.runs,
        "paper": row.paper,
        "scores_seen": row.scores_seen,
    }
