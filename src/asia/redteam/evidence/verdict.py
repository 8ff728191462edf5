"""Conversion of the observations of an attack to a finding."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Collection, Mapping, Sequence

from asia.errors import Reason
from asia.redteam._types import AttackVerdict, Barrier, CandidateAttack, Finding, Observed, Success
from asia.redteam.attacks.source import STEPS
from asia.sandbox import Layer

# Which layer answers with which error, where it is in force.
_BY_ERROR: dict[str, tuple[Barrier, ...]] = {
    "EACCES": (Barrier.LANDLOCK,),
    "EXDEV": (Barrier.LANDLOCK,),
    "EPERM": (Barrier.SECCOMP, Barrier.LANDLOCK, Barrier.NAMESPACES),
    "ENOSYS": (Barrier.SECCOMP,),
    "ENOMEM": (Barrier.RLIMITS,),
    "MemoryError": (Barrier.RLIMITS,),
    "_ArrayMemoryError": (Barrier.RLIMITS,),
    "EFBIG": (Barrier.RLIMITS,),
}
_BY_REASON = {
    Reason.LITERAL_DATA: Barrier.LINT,
    Reason.SUSPECT: Barrier.METAMORPHIC,
    Reason.RESTART: Barrier.METAMORPHIC,
    Reason.FIT_TIMEOUT: Barrier.DEADLINE,
    Reason.SIMULATE_TIMEOUT: Barrier.DEADLINE,
    Reason.MEMORY: Barrier.RLIMITS,
}


def said_steps(output: str) -> dict[str, str]:
    """Parse the result of each attempt from the output of a candidate."""
    for line in output.splitlines():
        if line.startswith(STEPS):
            try:
                found: Mapping[str, object] = json.loads(line.removeprefix(STEPS))
            except ValueError:
                return {}
            return {name: str(end) for name, end in found.items()}
    return {}


def conclude(
    attack: CandidateAttack, name: str, seen: Observed, layers: Sequence[Layer], success: Success
) -> Finding:
    """Judge one variant of an attack behind these layers.

    The error of a step names the layer that refused it, where that layer is in force.

    Args:
        success: criterion for success
    """

    def finding(verdict: AttackVerdict, stops: Collection[Barrier], note: str) -> Finding:
        words = f"{name}: {note}" if name else note
        return Finding(attack.number, "", verdict, tuple(dict.fromkeys(map(str, stops))), words)

    traces = [_success(seen)] if success(seen) else []
    traces += [f"left behind: {len(seen.survivors)} processes"] if seen.survivors else []
    traces += [f"left behind: {len(seen.strays)} files"] if seen.strays else []
    traces += ["a secret was read"] if seen.leaked else []
    traces += ["the ledger was changed"] if seen.ledger else []
    traces += [seen.hurt] if seen.hurt else []
    traces += ["its code ran in the evaluator"] if seen.ran else []
    if traces:
        return finding(AttackVerdict.THROUGH, (), ", ".join(traces))
    if seen.steps:
        ends = Counter(end for end in seen.steps.values() if end != "done")
        note = ", ".join(f"{end} x{n}" if n > 1 else end for end, n in ends.items())
        stops = [_layer(end, layers) for end in ends]
        verdict = AttackVerdict.NO_GAIN if "done" in seen.steps.values() else AttackVerdict.BLOCKED
        return finding(verdict, stops or [Barrier.PARENT], note)
    if seen.reason is not None:
        stop = _BY_REASON.get(seen.reason, Barrier.PARENT)
        flagged = stop in (Barrier.LINT, Barrier.METAMORPHIC)
        words = seen.reason.value
        if seen.reason is Reason.SUSPECT:
            words = ", ".join(part.partition(":")[0].strip() for part in seen.detail.split(";"))
        return finding(AttackVerdict.FLAGGED if flagged else AttackVerdict.BLOCKED, [stop], words)
    if seen.value is None:
        return finding(AttackVerdict.BLOCKED, [Barrier.PARENT], "no score")
    return finding(
        AttackVerdict.NO_GAIN, [Barrier.PARENT], f"V {seen.value:.3g}, honest {seen.honest:.3g}"
    )


def worst_of(
    found: Sequence[Finding], number: int, level: str, without: tuple[str, ...] = ()
) -> Finding:
    """One finding for all variants."""
    order = list(AttackVerdict)
    worst = max(found, key=lambda f: order.index(f.verdict))
    if worst.verdict is AttackVerdict.THROUGH:
        return Finding(number, level, AttackVerdict.THROUGH, (), worst.note, without)
    stops = tuple(dict.fromkeys(stop for f in found for stop in f.stops))
    notes = "; ".join(f.note for f in found)
    return Finding(number, level, worst.verdict, stops, notes, without)


def _success(seen: Observed) -> str:
    done = [name for name, end in seen.steps.items() if end == "done"]
    if done:
        return ", ".join(done)
    if seen.value is not None and seen.value < seen.honest:
        return f"V {seen.value:.3g}, honest {seen.honest:.3g}"
    return f"after {seen.seconds:.1f} s" if seen.limit < seen.seconds else "it was heard"


def _layer(end: str, layers: Sequence[Layer]) -> Barrier:
    """The layer that gives this error; the kernel's ordinary rules where none of those is there."""
    wanted = _BY_ERROR.get(end, (Barrier.NAMESPACES,))
    names = [str(layer) for layer in layers]
    return next((stop for stop in wanted if stop.value in names), Barrier.KERNEL)
