"""Text of an ablation."""

from __future__ import annotations

from collections.abc import Iterator

from asia.ledger import Ablated, LeftOut, error_value
from asia.scoring import Interval


def ablation_lines(found: Ablated, v_name: str = "V") -> Iterator[str]:
    """Yield the causes of the gain, and a line for each change that was left out."""
    crossing = found.crossing
    if crossing is None:
        yield f"model and training cannot be crossed: {found.detail}"
    else:
        yield (
            f"{v_name} of the winner #{found.winner:02d} is lower than that of the baseline by "
            f"{_words(crossing.gain)}"
        )
        for name, part in (
            ("its model", crossing.model),
            ("its training", crossing.training),
            ("both together", crossing.interaction),
        ):
            share = crossing.share(part)
            told = "" if share is None else f"{100 * share:5.0f} %  "
            yield f"  {name:<14} {told}{_words(part)}"
    for one in found.left_out:
        yield _left_out_line(one, v_name)


def _left_out_line(one: LeftOut, v_name: str) -> str:
    name = f"without the change of #{one.experiment:02d}"
    if one.loss is None:
        return f"{name}: not known; {one.detail}"
    return f"{name}: {v_name} is higher by {_words(one.loss)}"


def _words(interval: Interval) -> str:
    ends = f"{error_value(interval.low)} to {error_value(interval.high)}"
    alone = interval.low == interval.high
    return error_value(interval.value) + ("" if alone else f" ({ends})")
