"""State-space networks with an encoder."""

from __future__ import annotations

from asia.agents.library.card import Card
from asia.agents.library.cost import Timing
from asia.agents.library.methods import integrator_moves, integrator_setting
from asia.agents.library.network import STEP_BY_STEP, NetworkStart, network_family
from asia.agents.library.space import OneOf, Parameter
from asia.agents.view import Facts


def _start(facts: Facts) -> NetworkStart:
    """Return the initial network; over windows the state starts from the last outputs and must be
    large enough to hold them."""
    least = len(facts.outputs) if facts.horizon is not None else 1
    sizes = {n for n in (2, 4, 8) if n >= least}
    if least > 1:
        sizes |= {least, least + 4}
    return NetworkStart(
        (("states", max(4, least)), ("width", 32), ("layers", 1), *integrator_setting(facts)),
        2e-3,
        "medium",
        (
            OneOf("states", tuple(sorted(sizes))),
            OneOf("width", (16, 32, 64)),
            OneOf("layers", (1, 2)),
            OneOf("start", ("linear", "random")),
            *_integrators_space(facts),
        ),
    )


def _integrators_space(facts: Facts) -> tuple[Parameter, ...]:
    """Windows are too short to tell them from slow states."""
    return (OneOf("integrators", (0, 1)),) if facts.horizon is None else ()


CARD = Card((
    network_family(
        "subnet",
        "SUBNET",
        "state-space networks with an encoder, trained on truncated simulations: long records",
        4,
        (("long", 3), ("several", 1), ("windows", -1)),
        _start,
        STEP_BY_STEP,
        small=(("states", 2), ("width", 4), ("layers", 1)),
        timing=Timing(start=3.9, unit=4.3e-07),
    ),
), integrator_moves())  # fmt: skip
