"""Page USE.md, which is written next to every target."""

from __future__ import annotations

from collections.abc import Sequence

from asia.data import Signal
from asia.export._model import ExportModel
from asia.export._parity import ParityRow
from asia.export._target import Target


def usage_page(target: Target, model: ExportModel, rows: Sequence[ParityRow]) -> str:
    """Describe the model, the use of the files and the comparison with ASIA."""
    low = model.lowered
    lines = [
        f"# {model.problem}: {model.use} of run {model.name}",
        "",
        f"Inputs {_signals(model.inputs)}; outputs {_signals(model.outputs)}; sampling time "
        f"{model.sampling_time:g} s. Inputs are held between samples. The model starts from a "
        f"past window of {low.n_past_u} inputs and {low.n_past_y} outputs, the oldest first, and "
        "the input of the first sample. Output k belongs to input k.",
        "",
        target.usage,
        "",
        "| compared on the training windows | largest difference | microseconds a sample | bytes |",
        "|---|---|---|---|",
        *(_row(row) for row in rows),
        "",
        "The difference is relative to the spread of the measured output.",
    ]
    for signal, (low_end, high) in zip(model.inputs, model.input_range.tolist(), strict=True):
        lines.append(f"Trained with {signal.name} from {low_end:g} to {high:g} {signal.unit}.")
    for band in model.bands:
        width = ", ".join(f"{w:.3g}" for w in band.half_width.tolist())
        lines.append(
            f"About {band.level:.0%} of measured outputs lie within {width} of the simulation, "
            "inside the region of the training records."
        )
    return "\n".join([*lines, *model.notes, ""])


def table(rows: Sequence[ParityRow]) -> list[str]:
    """Comparison as lines for a terminal."""
    found = [f"{'target':16}{'difference':>12}{'us/sample':>12}{'bytes':>10}"]
    for row in rows:
        gap = "not run" if row.difference is None else f"{row.difference:.1e}"
        time = "" if row.microseconds is None else f"{row.microseconds:.2f}"
        note = f"  {row.note}" if row.note else ""
        found.append(f"{row.target:16}{gap:>12}{time:>12}{row.bytes:>10}{note}")
    return found


def _row(row: ParityRow) -> str:
    gap = "" if row.difference is None else f"{row.difference:.1e}"
    gap = ", ".join(part for part in (gap, row.note) if part)
    time = "" if row.microseconds is None else f"{row.microseconds:.2f}"
    return f"| {row.target} | {gap} | {time} | {row.bytes} |"


def _signals(signals: Sequence[Signal]) -> str:
    return ", ".join(f"{s.name} [{s.unit}]" if s.unit else s.name for s in signals)
