"""Summary of a dry run in a few lines of text."""

from __future__ import annotations

from asia.drive._answers import DryRunSummary
from asia.errors import Reason

_OVER_TIME = (Reason.FIT_TIMEOUT, Reason.SIMULATE_TIMEOUT)


def dry_run_lines(found: DryRunSummary) -> list[str]:
    """Describe a dry run, for users and agents."""
    where = f"on {found.samples} of the {found.of_samples} samples that fold 1 trains on"
    if found.reason is None:
        lines = [f"dry run  passed {where}: contract, shapes, finite answers, reloading"]
    else:
        lines = [f"dry run  fails {where}: {found.advice}"]
    if found.detail:
        lines.append(f"    text of the candidate: {found.detail}")
    if found.reason in _OVER_TIME and found.allowed_seconds < found.limit_seconds:
        lines.append(
            f"    a dry run ends after {found.allowed_seconds:g} s; the limit of a fit is "
            f"{found.limit_seconds:g} s"
        )
    if found.fit_seconds is not None:
        lines.append(
            f"    fit {found.fit_seconds:.1f} s, simulate {found.simulate_seconds:.1f} s, of "
            f"which {found.compile_seconds:.1f} s compilation"
        )
    whole = found.whole_fit_seconds
    if whole is not None:
        over = "  ABOVE THE LIMIT" if whole > found.limit_seconds else ""
        lines.append(
            f"    the whole fold: about {whole:.0f} s if the time grows with the samples, limit "
            f"{found.limit_seconds:g} s{over}"
        )
    if found.printed:
        lines.append("    printed by the candidate:")
        lines += [f"      {line}" for line in found.printed]
    lines.append("    no experiment was used, and no score was computed")
    return lines
