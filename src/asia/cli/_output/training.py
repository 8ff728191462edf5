"""Residual analysis of the training data as text."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from asia.ledger import Diagnostics


def training_lines(found: Diagnostics) -> tuple[str, ...]:
    """Return the figures of the worst output, of a fold or of the worst fold."""
    return (
        f"training side, worst fold and output: error {found.train_error:.3g} as in V, mean "
        f"residual {found.bias:.2g} s.d.",
        f"  correlation of the residual with its own past {found.whiteness:.2f}, with past inputs "
        f"{found.input_correlation:.2f}, with the squared output {found.curvature:.2f}",
        f"  RMS residual over that of all samples: output in its top tenth {found.top_error:.2f}, "
        f"bottom tenth {found.bottom_error:.2f}; first 5 % of a record {found.start_error:.2f}",
    )
