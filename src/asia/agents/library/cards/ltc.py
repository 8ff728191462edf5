"""Networks of states that decay with learned time constants."""

from __future__ import annotations

from dataclasses import replace

from asia.agents.library.card import Card
from asia.agents.library.cost import Timing
from asia.agents.library.network import STEP_BY_STEP, NetworkStart, network_family
from asia.agents.library.space import OneOf

_FAMILIES = (
    network_family(
        "ltc",
        "LTC network",
        "states that decay with learned time constants: dissipative systems",
        5,
        (("windows", -2), ("short", 0.5)),
        NetworkStart(
            (("hidden", 64),),
            1e-3,
            "medium",
            (OneOf("hidden", (8, 16, 32, 64)), OneOf("tau_max", (10.0, 25.0, 100.0))),
        ),
        STEP_BY_STEP,
        small=(("hidden", 3),),
        timing=Timing(start=3.0, unit=5e-07),
    ),
    network_family(
        "cascaded_ltc",
        "cascaded LTC network",
        "slow and fast states in a cascade: systems with two time scales",
        3.5,
        (("windows", -2),),
        NetworkStart(
            (("slow", 16), ("fast", 16), ("width", 32)),
            1e-3,
            "medium",
            (OneOf("slow", (8, 16, 32)), OneOf("fast", (8, 16, 32)), OneOf("width", (16, 32))),
        ),
        STEP_BY_STEP,
        small=(("slow", 2), ("fast", 2), ("width", 4)),
        timing=Timing(start=4.8, unit=9e-07),
    ),
)  # fmt: skip

# States that decay cannot add up.
CARD = Card(tuple(replace(row, against=frozenset({"integrating"})) for row in _FAMILIES))
