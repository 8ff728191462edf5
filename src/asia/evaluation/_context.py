"""Context of all candidates of a search."""

from __future__ import annotations

from asia.candidate import Context
from asia.problem.load import Problem


def search_context(problem: Problem, seed: int) -> Context:
    """Return the context of a search with this derived seed, without the fields that differ by
    fold."""
    rule = problem.protocol
    return Context(
        inputs=problem.inputs,
        outputs=problem.outputs,
        sampling_time=problem.sampling_time,
        n_past_u=rule.past_inputs,
        n_past_y=rule.past_outputs,
        horizon=rule.horizon,
        metric=rule.metric,
        physics=problem.physics,
        symmetry=problem.symmetry,
        seed=seed,
    )
