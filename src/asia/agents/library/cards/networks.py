"""Networks trained by Adam: a short fit first, a long one when it is promising."""

from collections.abc import Callable
from dataclasses import replace

from asia.agents.library.family import Family, SampleCost, Stage, Timing, steps
from asia.agents.library.methods import (
    adam,
    adam_space,
    by_lbfgs,
    by_multiple_shooting,
    integrator_moves,
    integrator_setting,
    symmetry_space,
)
from asia.agents.library.move import Card
from asia.agents.library.space import OneOf, Parameter, Space, Span
from asia.agents.library.traits import Trait
from asia.agents.view import Facts
from asia.recipe import Arguments, Recipe

# Multiple shooting can set the state of networks that step through time. Others map a whole record
# at once.
_STEP_BY_STEP = (by_lbfgs, by_multiple_shooting)
_WHOLE_RECORD = (by_lbfgs,)
_INTEGRATING: frozenset[Trait] = frozenset({"integrating"})


def _network(
    name: str,
    label: str,
    use: str,
    base: float,
    points: tuple[tuple[Trait, float], ...],
    *,
    config: Arguments | Callable[[Facts], Arguments],
    vary: tuple[Parameter, ...] | Callable[[Facts], tuple[Parameter, ...]],
    small: Arguments,
    rate: float,
    cost: SampleCost = "medium",
    methods: tuple[Callable[[Facts, Recipe], Recipe], ...] = _STEP_BY_STEP,
    teacher: float | None = None,
    timing: Timing | None = None,
    unfit: frozenset[Trait] = frozenset(),
    against: frozenset[Trait] = frozenset(),
) -> Family:
    """Make the row of a network.

    Args:
        config: settings of the first configuration
        vary: search space besides the settings of Adam and the functions of the inputs
        small: the sizes for tests; the steps of the fit are added
        rate: learning rate of the first fit
        cost: cost of a sample
        methods: other ways to train it
        teacher: initial rate of teacher forcing; None where the model feeds back no output
    """

    def first(facts: Facts, stage: Stage) -> Recipe:
        settings = config(facts) if callable(config) else config
        recipe = Recipe(name, settings, "Adam", adam(facts, cost, stage, rate))
        return recipe.trained(teacher=teacher) if teacher else recipe

    def space(facts: Facts) -> Space:
        least, most = steps(facts, cost, "trial") // 2, steps(facts, cost, "full")
        options: list[Parameter] = [
            Span("steps", least, most, whole=True),
            *adam_space(facts),
            OneOf("members", (1, 3)),
            *symmetry_space(facts),
        ]
        if teacher is not None:
            options += [OneOf("teacher", (0.0, 0.3, 1.0)), OneOf("teacher_end", (0.0,))]
        varied = vary(facts) if callable(vary) else vary
        return Space((*varied, OneOf("features", ((), ("square",)))), tuple(options))

    return Family(
        name=name,
        label=label,
        use=use,
        base=base,
        points=points,
        unfit=unfit,
        against=against,
        start=lambda facts: first(facts, "trial"),
        longer=lambda facts: first(facts, "full"),
        space=space,
        small=(*small, ("steps", 5)),
        timing=timing or Timing(),
        methods=methods,
        seeds=True,
    )


_RECURRENT = _network(
    "recurrent",
    "recurrent network",
    "a general gated network, for systems without prior knowledge",
    4,
    (("long", 2),),
    config=(("cell", "gru"), ("hidden", 16), ("layers", 1)),
    vary=(
        OneOf("cell", ("rnn", "gru", "lstm")),
        OneOf("hidden", (8, 16, 32, 64)),
        OneOf("layers", (1, 2)),
    ),
    small=(("hidden", 3), ("layers", 1)),
    rate=3e-3,
    timing=Timing(start=3.3, unit=8.3e-07),
)


def _fed_back(
    name: str, label: str, use: str, windows: float, teacher: float, timing: Timing | None = None
) -> Family:
    """Make the row of a recurrent network fed with its own output."""
    return _network(
        name,
        label,
        use,
        2.5,
        (("windows", windows), ("measured", 2)),
        config=(("cell", "lstm"), ("hidden", 32), ("layers", 1)),
        vary=(
            OneOf("cell", ("gru", "lstm")),
            OneOf("hidden", (16, 32, 64)),
            OneOf("layers", (1, 2)),
        ),
        small=(("hidden", 3), ("layers", 1)),
        rate=2e-3,
        teacher=teacher,
        timing=timing,
    )


_AUTOREGRESSIVE = _fed_back(
    "autoregressive",
    "autoregressive network",
    "increments of the last output, fed back: short windows from a measured state",
    windows=3,
    teacher=0.0,
    timing=Timing(start=4.2, unit=2.1e-07),
)
_KINEMATIC = replace(
    _fed_back(
        "kinematic",
        "kinematic network",
        "increments of velocities, integrated to positions: outputs that are rates of others",
        windows=4,
        teacher=0.3,
    ),
    needs=frozenset({"windows", "several"}),
)

# States that decay cannot add up.
_LTC = _network(
    "ltc",
    "LTC network",
    "states that decay with learned time constants: dissipative systems",
    5,
    (("windows", -2), ("short", 0.5)),
    config=(("hidden", 64),),
    vary=(OneOf("hidden", (8, 16, 32, 64)), OneOf("tau_max", (10.0, 25.0, 100.0))),
    small=(("hidden", 3),),
    rate=1e-3,
    timing=Timing(start=3.0, unit=5e-07),
    against=_INTEGRATING,
)
_CASCADED_LTC = _network(
    "cascaded_ltc",
    "cascaded LTC network",
    "slow and fast states in a cascade: systems with two time scales",
    3.5,
    (("windows", -2),),
    config=(("slow", 16), ("fast", 16), ("width", 32)),
    vary=(OneOf("slow", (8, 16, 32)), OneOf("fast", (8, 16, 32)), OneOf("width", (16, 32))),
    small=(("slow", 2), ("fast", 2), ("width", 4)),
    rate=1e-3,
    timing=Timing(start=4.8, unit=9e-07),
    against=_INTEGRATING,
)


def _least_states(facts: Facts) -> int:
    """Over windows the state starts from the last outputs and must be large enough to hold them."""
    return len(facts.outputs) if facts.horizon is not None else 1


def _subnet_config(facts: Facts) -> Arguments:
    states = max(4, _least_states(facts))
    return (("states", states), ("width", 32), ("layers", 1), *integrator_setting(facts))


def _subnet_space(facts: Facts) -> tuple[Parameter, ...]:
    least = _least_states(facts)
    sizes = {n for n in (2, 4, 8) if n >= least}
    if least > 1:
        sizes |= {least, least + 4}
    # Windows are too short to tell integrators from slow states.
    integrators = (OneOf("integrators", (0, 1)),) if facts.horizon is None else ()
    return (
        OneOf("states", tuple(sorted(sizes))),
        OneOf("width", (16, 32, 64)),
        OneOf("layers", (1, 2)),
        OneOf("start", ("linear", "random")),
        *integrators,
    )


_SUBNET = _network(
    "subnet",
    "SUBNET",
    "state-space networks with an encoder, trained on truncated simulations: long records",
    4,
    (("long", 3), ("several", 1), ("windows", -1)),
    config=_subnet_config,
    vary=_subnet_space,
    small=(("states", 2), ("width", 4), ("layers", 1)),
    rate=2e-3,
    timing=Timing(start=3.9, unit=4.3e-07),
)

_KOOPMAN = _network(
    "koopman",
    "Koopman model",
    "a linear model in lifted coordinates: mild nonlinearities, when a linear core is wanted",
    2.5,
    (("windows", 0.5),),
    config=(("levels", 3), ("states", 16), ("lift", 8), ("width", 32)),
    vary=(
        OneOf("levels", (1, 2, 3)),
        OneOf("states", (8, 16, 32)),
        OneOf("lift", (4, 8, 16)),
        OneOf("width", (16, 32)),
    ),
    small=(("levels", 2), ("states", 2), ("lift", 2), ("width", 4)),
    rate=3e-3,
    cost="heavy",
    methods=_WHOLE_RECORD,
    timing=Timing(start=2.9, unit=1e-06),
)

# A fading memory cannot integrate.
_CNN = _network(
    "cnn",
    "convolutional network",
    "fading memory seen through dilated convolutions of the inputs: long records",
    2,
    (("long", 2), ("windows", -1)),
    config=(("receptive_field", 128), ("width", 16)),
    vary=(OneOf("receptive_field", (32, 64, 128, 256)), OneOf("width", (8, 16, 32))),
    small=(("receptive_field", 8), ("width", 4)),
    rate=3e-3,
    cost="heavy",
    methods=_WHOLE_RECORD,
    timing=Timing(start=8.6, unit=3.1e-06),
    unfit=_INTEGRATING,
)
_TRANSFORMER = _network(
    "transformer",
    "Transformer",
    "attention over past inputs: long records of systems that no simpler model fits",
    1,
    (("long", 1),),
    config=(("layers", 2), ("width", 32), ("span", 64)),
    vary=(OneOf("layers", (1, 2)), OneOf("width", (16, 32)), OneOf("span", (32, 64, 128))),
    small=(("layers", 1), ("width", 4), ("span", 8)),
    rate=1e-3,
    cost="heavy",
    methods=_WHOLE_RECORD,
    timing=Timing(start=4.7, unit=1.8e-06),
    unfit=_INTEGRATING,
)

CARD = Card(
    (
        _RECURRENT,
        _AUTOREGRESSIVE,
        _KINEMATIC,
        _LTC,
        _CASCADED_LTC,
        _SUBNET,
        _KOOPMAN,
        _CNN,
        _TRANSFORMER,
    ),
    tuple(replace(move, families=("subnet",)) for move in integrator_moves()),
)
