"""Result of the expert at the same budget, for comparison with a search that costs money."""

from dataclasses import dataclass
from pathlib import Path

from asia.agents.expert.agent import ExpertAgent
from asia.agents.registry import agent_row
from asia.errors import UserError
from asia.ledger.chain import read_lines
from asia.ledger.events import Started
from asia.ledger.run import open_run
from asia.presentation.table import error_value


@dataclass(frozen=True)
class ExpertResult:
    """`run` of the expert and its best V within the first `experiments`; None while there is
    no such run, or no score in it."""

    run: str | None
    value: float | None
    experiments: int


def expert_result(directory: Path, start: Started, spent: int) -> ExpertResult | None:
    """Return what the expert found at the same budget; None where the agent writes no code.

    Of several runs in the same folder, the one with the same seed counts, else the first.
    spent: number of experiments that the search has spent.
    """
    if not agent_row(start.agent).writes_code or spent == 0:
        return None
    own = directory.resolve()
    found: list[tuple[bool, str, Path]] = []
    for ledger in sorted(own.parent.glob("*/ledger.jsonl")):
        if ledger.parent == own:
            continue
        try:
            first = next(read_lines(ledger), None)
        except UserError:
            continue
        other = None if first is None else first.event
        if (
            isinstance(other, Started)
            and other.agent == ExpertAgent.name
            and other.problem == start.problem
            and other.protocol_digest == start.protocol_digest
            and other.early_stopping == start.early_stopping
        ):
            found.append((other.seed != start.seed, other.run, ledger.parent))
    for _, name, place in sorted(found):
        try:
            view = open_run(place).view
        except UserError:
            continue
        finished = view.finished[:spent]
        if len(finished) == spent or view.stopped is not None:
            values = [e.score.value for e in finished if e.score]
            return ExpertResult(name, min(values, default=None), spent)
    return ExpertResult(None, None, spent)


def expert_text(found: ExpertResult, start: Started) -> str:
    """Describe the result in one line."""
    if found.run is None:
        return (
            "not run yet; to run the expert, which needs no language model, at the same budget: "
            f"asia run {start.problem} --experiments {found.experiments} --seed {start.seed}"
        )
    value = "no score" if found.value is None else f"V={error_value(found.value)}"
    return f"expert, the same {found.experiments} experiments: {value} ({found.run})"
