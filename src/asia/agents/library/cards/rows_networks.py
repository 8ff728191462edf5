"""Families of networks, trained by Adam: a short fit first, a long one when it is promising."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from asia.agents._view import Facts
from asia.agents.library.cost import Cost, Stage, adam, network_space
from asia.agents.library.family import Family
from asia.agents.library.recipe import Recipe, Settings
from asia.agents.library.space import Choice, Parameter, Space
from asia.agents.library.traits import Trait

CELLS = ("LBFGS", "MultipleShooting")
MAPS = ("LBFGS",)


@dataclass(frozen=True)
class Network:
    """What a row of networks needs beside the words: settings of the first configuration, learning
    rate, cost of a sample, and what may be varied; teacher: how often it is fed measured outputs at
    first, None where it feeds on no output."""

    config: Settings
    rate: float
    cost: Cost
    vary: tuple[Parameter, ...]
    teacher: float | None = None


def _row(
    name: str,
    label: str,
    use: str,
    base: float,
    points: tuple[tuple[Trait, float], ...],
    network: Network | Callable[[Facts], Network],
    methods: tuple[str, ...],
    needs: frozenset[Trait] = frozenset(),
) -> Family:
    def suited(facts: Facts) -> Network:
        return network if isinstance(network, Network) else network(facts)

    def recipe(stage: Stage) -> Callable[[Facts], Recipe]:
        def found(facts: Facts) -> Recipe:
            own = suited(facts)
            recipe = Recipe(name, own.config, "Adam", adam(facts, own.cost, stage, own.rate))
            return recipe.trained(teacher=own.teacher) if own.teacher else recipe

        return found

    def space(facts: Facts) -> Space:
        own = suited(facts)
        found = network_space(facts, own.cost, own.vary)
        if own.teacher is None:
            return found
        teacher = (Choice("teacher", (0.0, 0.3, 1.0)), Choice("teacher_end", (0.0,)))
        return replace(found, options=(*found.options, *teacher))

    return Family(
        name=name,
        label=label,
        use=use,
        base=base,
        points=points,
        needs=needs,
        trial=recipe("trial"),
        full=recipe("full"),
        space=space,
        methods=methods,
        seeds=True,
    )


def _subnet(facts: Facts) -> Network:
    """Over windows the state starts from the last outputs and must be large enough to hold them."""
    least = len(facts.outputs) if facts.horizon is not None else 1
    sizes = {n for n in (2, 4, 8) if n >= least}
    if least > 1:
        sizes |= {least, least + 4}
    return Network(
        (("states", max(4, least)), ("width", 32), ("layers", 1)),
        2e-3,
        "medium",
        (
            Choice("states", tuple(sorted(sizes))),
            Choice("width", (16, 32, 64)),
            Choice("layers", (1, 2)),
            Choice("start", ("linear", "random")),
        ),
    )


NETWORKS: tuple[Family, ...] = (
    _row(
        "ltc",
        "LTC network",
        "states that decay with learned time constants: dissipative systems",
        5,
        (("windows", -2), ("short", 0.5)),
        Network(
            (("hidden", 64),),
            1e-3,
            "medium",
            (Choice("hidden", (8, 16, 32, 64)), Choice("tau_max", (10.0, 25.0, 100.0))),
        ),
        CELLS,
    ),
    _row(
        "subnet",
        "SUBNET",
        "state-space networks with an encoder, trained on truncated simulations: long records",
        4,
        (("long", 3), ("several", 1), ("windows", -1)),
        _subnet,
        CELLS,
    ),
    _row(
        "recurrent",
        "recurrent network",
        "a general gated network, when nothing is known of the system",
        4,
        (("long", 2),),
        Network(
            (("cell", "gru"), ("hidden", 16), ("layers", 1)),
            3e-3,
            "medium",
            (
                Choice("cell", ("rnn", "gru", "lstm")),
                Choice("hidden", (8, 16, 32, 64)),
                Choice("layers", (1, 2)),
            ),
        ),
        CELLS,
    ),
    _row(
        "autoregressive",
        "autoregressive network",
        "increments of the last output, fed back: short windows from a measured state",
        2.5,
        (("windows", 3), ("measured", 2)),
        Network(
            (("cell", "lstm"), ("hidden", 32), ("layers", 1)),
            2e-3,
            "medium",
            (
                Choice("cell", ("gru", "lstm")),
                Choice("hidden", (16, 32, 64)),
                Choice("layers", (1, 2)),
            ),
            teacher=0.0,
        ),
        CELLS,
    ),
    _row(
        "kinematic",
        "kinematic network",
        "increments of velocities, integrated to positions: outputs that are rates of others",
        2.5,
        (("windows", 4), ("measured", 2)),
        Network(
            (("cell", "lstm"), ("hidden", 32), ("layers", 1)),
            2e-3,
            "medium",
            (
                Choice("cell", ("gru", "lstm")),
                Choice("hidden", (16, 32, 64)),
                Choice("layers", (1, 2)),
            ),
            teacher=0.3,
        ),
        CELLS,
        needs=frozenset({"windows", "several"}),
    ),
    _row(
        "cascaded_ltc",
        "cascaded LTC network",
        "slow and fast states in a cascade: systems with two time scales",
        3.5,
        (("windows", -2),),
        Network(
            (("slow", 16), ("fast", 16), ("width", 32)),
            1e-3,
            "medium",
            (Choice("slow", (8, 16, 32)), Choice("fast", (8, 16, 32)), Choice("width", (16, 32))),
        ),
        CELLS,
    ),
    _row(
        "lru",
        "linear recurrent units",
        "stable linear states between static networks: long memories, long records",
        3,
        (("long", 3), ("windows", -1)),
        Network(
            (("layers", 2), ("states", 16), ("width", 16)),
            3e-3,
            "heavy",
            (
                Choice("layers", (1, 2, 3)),
                Choice("states", (8, 16, 32)),
                Choice("width", (8, 16, 32)),
                Choice("tau_max", (30.0, 100.0, 300.0)),
            ),
        ),
        MAPS,
    ),
    _row(
        "koopman",
        "Koopman model",
        "a linear model in lifted coordinates: mild nonlinearities, when a linear core is wanted",
        2.5,
        (("windows", 0.5),),
        Network(
            (("levels", 3), ("states", 16), ("lift", 8), ("width", 32)),
            3e-3,
            "heavy",
            (
                Choice("levels", (1, 2, 3)),
                Choice("states", (8, 16, 32)),
                Choice("lift", (4, 8, 16)),
                Choice("width", (16, 32)),
            ),
        ),
        MAPS,
    ),
    _row(
        "cnn",
        "convolutional network",
        "fading memory seen through dilated convolutions of the inputs: long records",
        2,
        (("long", 2), ("windows", -1)),
        Network(
            (("receptive_field", 128), ("width", 16)),
            3e-3,
            "heavy",
            (Choice("receptive_field", (32, 64, 128, 256)), Choice("width", (8, 16, 32))),
        ),
        MAPS,
    ),
    _row(
        "transformer",
        "Transformer",
        "attention over past inputs: long records of systems that nothing simpler fits",
        1,
        (("long", 1),),
        Network(
            (("layers", 2), ("width", 32), ("span", 64)),
            1e-3,
            "heavy",
            (
                Choice("layers", (1, 2)),
                Choice("width", (16, 32)),
                Choice("span", (32, 64, 128)),
            ),
        ),
        MAPS,
    ),
)
