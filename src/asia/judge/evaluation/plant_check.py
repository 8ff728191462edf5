"""Trial of a simulator of the user's own, in the sandbox, before a search."""

from asia.errors import CandidateError, Reason, UserError
from asia.judge.evaluation.fold_fits import search_context
from asia.judge.sandbox.availability import open_worker
from asia.judge.sandbox.types import Isolation, Limits
from asia.problem.problem import Problem

# Simulations of one record in a fit, and the share of a parameter in directions without an effect
# from which it counts as unknown.
_SIMULATIONS, _LOST = 500, 0.1
_PROBE = """from asia.models import simulator


def fit(trajectories, context):
    return simulator.probe(trajectories, context)
"""


def check_plant(problem: Problem, isolation: Isolation) -> list[str]:
    """Try the simulator of the problem on its first record, in the sandbox.

    Returns:
        Findings, a line each; none without a simulator.

    Raises:
        UserError: with one sentence for a simulator that fails
    """
    plant, seconds = problem.plant, problem.budget.fit_seconds
    if plant is None:
        return []
    limits = Limits(seconds, seconds, problem.budget.memory_mb)
    try:
        with open_worker(isolation, limits) as worker:
            worker.fit(_PROBE, problem.train[:1], search_context(problem, 0))
            found = dict(worker.parameters())
    except CandidateError as error:
        last = error.detail.strip().rpartition("\n")[2].rpartition("SimulatorError: ")[2]
        text = {
            Reason.FIT_TIMEOUT: f"[plant] {plant.label} did not return within {seconds:g} s: look "
            "for an endless loop, or raise budget.fit_seconds",
            Reason.EXITED: f"[plant] {plant.label} ended its process: do not call exit, and look "
            "for a crash in compiled code",
            Reason.MEMORY: f"[plant] {plant.label} ran out of memory: raise budget.memory_mb",
        }.get(error.reason, last)
        raise UserError(text) from None
    took, failed = found["seconds"], found["failed"]
    lines = [
        f"simulator: {plant.label}, {len(plant.parameters)} parameters, {len(plant.initial)} "
        f"initial states; simulates record {problem.train[0].name} in {took:.2g} s"
    ]
    whole_fit = _SIMULATIONS * took * sum(map(len, problem.train)) / len(problem.train[0])
    if whole_fit > seconds:
        lines.append(
            f"simulator: a fit takes about {whole_fit:.0f} s, budget.fit_seconds is {seconds:g}: "
            "raise it, or make the simulator faster"
        )
    if failed:
        lines.append(f"simulator: {failed:.0%} of the points in the ranges fail: narrow them")
    if "gradient" not in found:
        return [*lines, "identifiability: not tested, the simulator is too slow"]
    if not found["gradient"]:
        lines.append(
            "simulator: finite differences are unreliable, as the simulator rounds or chooses its "
            "steps: the search goes without gradients, and only the folds show how sure it is"
        )
    lost = [name for name in plant.parameters if found.get(f"lost {name}"[:48], 0) > _LOST]
    verb = "has no effect" if len(lost) == 1 else "cannot be told apart"
    name = problem.train[0].name
    lines.append(
        f"identifiability: {', '.join(lost)} {verb} in record {name}: fix one of them in the "
        "simulator"
        if lost
        else f"identifiability: record {name} determines every parameter in principle"
    )
    return lines
