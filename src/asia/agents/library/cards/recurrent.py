"""Gated networks: of the inputs alone, or fed with their own output."""

from __future__ import annotations

from asia.agents.library.card import Card
from asia.agents.library.cost import Timing
from asia.agents.library.network import STEP_BY_STEP, NetworkStart, network_family
from asia.agents.library.space import OneOf


def _fed_back(teacher: float) -> NetworkStart:
    return NetworkStart(
        (("cell", "lstm"), ("hidden", 32), ("layers", 1)),
        2e-3,
        "medium",
        (OneOf("cell", ("gru", "lstm")), OneOf("hidden", (16, 32, 64)), OneOf("layers", (1, 2))),
        teacher=teacher,
    )


_SMALL = (("hidden", 3), ("layers", 1))

CARD = Card((
    network_family(
        "recurrent",
        "recurrent network",
        "a general gated network, for systems without prior knowledge",
        4,
        (("long", 2),),
        NetworkStart(
            (("cell", "gru"), ("hidden", 16), ("layers", 1)),
            3e-3,
            "medium",
            (
                OneOf("cell", ("rnn", "gru", "lstm")),
                OneOf("hidden", (8, 16, 32, 64)),
                OneOf("layers", (1, 2)),
            ),
        ),
        STEP_BY_STEP,
        small=_SMALL,
        timing=Timing(start=3.3, unit=8.3e-07),
    ),
    network_family(
        "autoregressive",
        "autoregressive network",
        "increments of the last output, fed back: short windows from a measured state",
        2.5,
        (("windows", 3), ("measured", 2)),
        _fed_back(teacher=0.0),
        STEP_BY_STEP,
        small=_SMALL,
        timing=Timing(start=4.2, unit=2.1e-07),
    ),
    network_family(
        "kinematic",
        "kinematic network",
        "increments of velocities, integrated to positions: outputs that are rates of others",
        2.5,
        (("windows", 4), ("measured", 2)),
        _fed_back(teacher=0.3),
        STEP_BY_STEP,
        needs=frozenset({"windows", "several"}),
        small=_SMALL,
    ),
))  # fmt: skip
