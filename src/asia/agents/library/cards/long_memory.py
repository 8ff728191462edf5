"""Networks with a long memory: linear states between static networks, convolutions, attention."""

from __future__ import annotations

from dataclasses import replace

from asia.agents.library.card import Card
from asia.agents.library.cost import Timing
from asia.agents.library.network import WHOLE_RECORD, NetworkStart, network_family
from asia.agents.library.space import OneOf

# Its states are stable: they cannot add up.
_LRU = replace(
    network_family(
        "lru",
        "linear recurrent units",
        "stable linear states between static networks: long memories, long records",
        3,
        (("long", 3), ("windows", -1)),
        NetworkStart(
            (("layers", 2), ("states", 16), ("width", 16)),
            3e-3,
            "heavy",
            (
                OneOf("layers", (1, 2, 3)),
                OneOf("states", (8, 16, 32)),
                OneOf("width", (8, 16, 32)),
                OneOf("tau_max", (30.0, 100.0, 300.0)),
            ),
        ),
        WHOLE_RECORD,
        small=(("layers", 1), ("states", 2), ("width", 4)),
    ),
    against=frozenset({"integrating"}),
)

_KOOPMAN = network_family(
    "koopman",
    "Koopman model",
    "a linear model in lifted coordinates: mild nonlinearities, when a linear core is wanted",
    2.5,
    (("windows", 0.5),),
    NetworkStart(
        (("levels", 3), ("states", 16), ("lift", 8), ("width", 32)),
        3e-3,
        "heavy",
        (
            OneOf("levels", (1, 2, 3)),
            OneOf("states", (8, 16, 32)),
            OneOf("lift", (4, 8, 16)),
            OneOf("width", (16, 32)),
        ),
    ),
    WHOLE_RECORD,
    small=(("levels", 2), ("states", 2), ("lift", 2), ("width", 4)),
    timing=Timing(start=2.9, unit=1e-06),
)

# A fading memory cannot integrate.
_UNFIT = frozenset({"integrating"})

_OF_INPUTS = (
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
        "attention over past inputs: long records of systems that no simpler model fits",
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

CARD = Card((_LRU, _KOOPMAN, *(replace(row, unfit=_UNFIT) for row in _OF_INPUTS)))
