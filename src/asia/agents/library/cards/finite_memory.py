"""Networks of a window of past inputs: convolutions and attention."""

from __future__ import annotations

from dataclasses import replace

from asia.agents.library.card import Card
from asia.agents.library.cost import Timing
from asia.agents.library.network import WHOLE_RECORD, NetworkStart, network_family
from asia.agents.library.space import OneOf

# What is forgotten after a while cannot add up.
_UNFIT = frozenset({"integrating"})

_FAMILIES = (
    network_family(
        "cnn",
        "convolutional network",
        "fading memory seen through dilated convolutions of the inputs: long records",
        2,
        (("long", 2), ("windows", -1)),
        NetworkStart(
            (("receptive_field", 128), ("width", 16)),
            3e-3,
            "heavy",
            (OneOf("receptive_field", (32, 64, 128, 256)), OneOf("width", (8, 16, 32))),
        ),
        WHOLE_RECORD,
        small=(("receptive_field", 8), ("width", 4)),
        timing=Timing(start=8.6, unit=3.1e-06),
    ),
    network_family(
        "transformer",
        "Transformer",
        "attention over past inputs: long records of systems that nothing simpler fits",
        1,
        (("long", 1),),
        NetworkStart(
            (("layers", 2), ("width", 32), ("span", 64)),
            1e-3,
            "heavy",
            (OneOf("layers", (1, 2)), OneOf("width", (16, 32)), OneOf("span", (32, 64, 128))),
        ),
        WHOLE_RECORD,
        small=(("layers", 1), ("width", 4), ("span", 8)),
        timing=Timing(start=4.7, unit=1.8e-06),
    ),
)  # fmt: skip

CARD = Card(tuple(replace(row, unfit=_UNFIT) for row in _FAMILIES))
