"""Official figures of a model, and its rank among the published ones."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from asia.report import Board


def board_lines(board: Board) -> Iterator[str]:
    """Yield the official figures of the model to use, their ranks among the published ones, and the
    line for the submission form; nothing if the problem is not a benchmark."""
    if not board.entries and board.unit_is_outputs:
        return
    width = max((len(s.figure.name) for s in board.standings), default=0)
    for standing in board.standings:
        figure = standing.figure
        line = f"official {figure.name:<{width}} {figure.value:.4g} {board.unit}"
        yield f"{line}  {standing.words}".rstrip()
    if board.submission:
        yield f"submit   {board.submission}"


def board_object(board: Board) -> dict[str, Any]:
    """Return the same as JSON; empty if the problem is not a benchmark."""
    if not board.entries and board.unit_is_outputs:
        return {}
    figures = {
        s.figure.name: {
            "value": s.figure.value,
            "rank": s.rank if s.among > 1 else None,
            "among": s.among,
            "above": None if s.above is None else {"value": s.above_value, "result": s.above.words},
        }
        for s in board.standings
    }
    return {"official": {"unit": board.unit, "figures": figures, "submission": board.submission}}
