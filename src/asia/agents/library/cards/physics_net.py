"""Problem's equations with all states measured: learned terms and a parallel network."""

from functools import partial

from asia.agents.library.family import GENTLE_STEPS, Family, Timing, steps
from asia.agents.library.methods import LM, absolute_loss, adam_space
from asia.agents.library.move import LIKELY, POSSIBLE, SHOWN, Card, Move, Situation
from asia.agents.library.space import OneOf, Parameter, Space, Span
from asia.agents.library.traits import names_places
from asia.agents.view import Facts, Trial
from asia.recipe import Arguments, Recipe


def _space(facts: Facts) -> Space:
    places: list[Parameter] = []
    if names_places(facts):
        places.append(Span("reach", 1.0, 4.0, needs="network"))
        if facts.symmetry:
            places.append(OneOf("symmetry", (False, True), needs="network"))
    # Members would share the validation scores of a fit.
    watched = facts.early_stopping == "validation"
    members = () if watched else (OneOf("members", (1, 2), needs="network"),)
    return Space(
        config=(
            OneOf("delay", (False, True)),
            *places,
            OneOf("linear", (False, True)),
            OneOf("lag", (False, True)),
            OneOf("gain", (False, True)),
            OneOf("disturbance", (False, True)),
            Span("sparsity", 1e-5, 1e-2, needs="linear"),
            Span("ridge", 1e-4, 1e-1, needs="linear"),
            OneOf("robust", (None, 0.1, 0.3, 1.0)),
            OneOf("windows", (240, 480)),
            OneOf("hidden", (16, 32, 64), needs="network"),
            OneOf("layers", (1, 2), needs="network"),
            Span("size", 0.03, 1.0, needs="network"),
        ),
        options=(
            OneOf("iterations", (10, 15, 30)),
            Span("steps", GENTLE_STEPS // 2, 2 * GENTLE_STEPS, whole=True, needs="network"),
            *members,
            OneOf("gentle", (0.0, 0.5, 1.0), needs="network"),
            OneOf("offset", (0.0, 0.1, 0.2), needs="network"),
            *adam_space(facts, needs="network"),
        ),
    )


def _has_network_at_places(at: Situation) -> bool:
    return names_places(at.facts) and bool(at.recipe.get("network"))


def _with_network(facts: Facts, recipe: Recipe, kind: str) -> Recipe:
    """Add a small network to fitted equations, trained gently from there, or with corrections
    trained together with the equations from the priors of the parameters."""
    if names_places(facts):
        return _network_at_places(facts, recipe, kind)
    recipe = recipe.configured(network=kind, hidden=32, size=0.1)
    if recipe.method == "Adam":
        return recipe
    options: Arguments = (
        ("steps", min(GENTLE_STEPS, steps(facts, "heavy", "full"))),
        ("learning_rate", 1e-3),
        ("weight_decay", 1e-2),
        ("batch", 64),
        *absolute_loss(facts),
    )
    return recipe.fitted_by("Adam", options)


def _network_at_places(facts: Facts, recipe: Recipe, kind: str) -> Recipe:
    """Start physics and network together from the priors, with networks at the given places.

    In closed loop a fit of the equations alone attributes the controller's action to the system.
    Linear terms are nearly held at zero, since the equations contain the linear effects.
    """
    symmetry: Arguments = (("symmetry", True),) if facts.symmetry else ()
    recipe = recipe.configured(
        linear=True, sparsity=0.0, ridge=1.0, delay=True, equations=0, reach=1.5,
        network=kind, hidden=32, size=1.0, **dict(symmetry),
    )  # fmt: skip
    if recipe.method == "Adam":
        return recipe
    options: Arguments = (
        ("steps", GENTLE_STEPS),
        ("learning_rate", 4e-3),
        ("weight_decay", 1e-3),
        ("batch", 256),
        ("gentle", 0.5),
        ("offset", 0.1),
        ("average", 0.99),
        *absolute_loss(facts),
    )
    return recipe.fitted_by("Adam", options)


def _without_network(at: Situation) -> Recipe:
    """The equations and their linear terms, by Levenberg-Marquardt."""
    recipe = at.recipe.configured(linear=True).without(
        "network", "hidden", "layers", "size", "symmetry", "reach", "equations"
    )
    return recipe.fitted_by(LM, (("iterations", 15),))


def _fitted_first(at: Situation) -> bool:
    """Return whether the equations are fitted by Levenberg-Marquardt, alone or before a network."""
    return at.recipe.number("equations", 15) > 0


def _stops_by_score(at: Situation) -> bool:
    """Return whether a fit may see its validation score, and stops a network by it."""
    return at.facts.early_stopping == "validation"


def _spread(trial: Trial) -> float:
    """The largest error of a fold over the mean of all: far above 1 a fold is unlike the others."""
    scores = trial.folds
    return max(scores) / (sum(scores) / len(scores)) if scores else 1.0


_MOVES: tuple[Move, ...] = (
    Move(
        name="network at the corrections",
        evidence=lambda c: SHOWN * names_places(c.facts) * (not c.recipe.get("network")),
        change=lambda c: _network_at_places(c.facts, c.recipe, "gru"),
        hypothesis="Known physics with its symmetries, started at probable parameters, leaves "
        "small unknown effects at known places for a network with memory.",
        expected="A much lower V in all folds.",
    ),
    Move(
        name="gentler windows",
        evidence=lambda c: (
            (LIKELY if _spread(c.trial) > 2.0 else POSSIBLE)
            * _has_network_at_places(c)
            * (c.recipe.number("gentle", 0.0) < 1.0)
        ),
        change=lambda c: c.recipe.trained(gentle=c.recipe.number("gentle", 0.0) + 0.5),
        hypothesis="The most dynamic windows dominate the loss, the fold with the largest error "
        "differs from them, and the laws are learned best where few other effects act.",
        expected="A higher training error and a lower V.",
    ),
    Move(
        name="earlier saturation",
        evidence=lambda c: (
            (LIKELY if _spread(c.trial) > 2.0 else POSSIBLE)
            * _has_network_at_places(c)
            * (c.recipe.number("reach", 3.0) > 1.0)
        ),
        change=lambda c: c.recipe.times("reach", 0.7, 3.0),
        hypothesis="The fold with the largest error leaves the range of its training records; a "
        "network whose inputs are bounded earlier does not extrapolate there.",
        expected="A lower V in that fold, about the same in the others.",
    ),
    Move(
        name="average of several seeds",
        evidence=lambda c: (
            bool(c.recipe.get("network"))
            and not _stops_by_score(c)
            and c.recipe.number("members", 1) < 2
        ),
        change=lambda c: c.recipe.trained(members=2),
        hypothesis="The random part of a network differs between seeds, and the mean has less of "
        "it.",
        expected="A lower V at the same training error.",
    ),
    Move(
        name="more windows",
        evidence=lambda c: LIKELY * (c.recipe.number("windows", 240) < 960) * _fitted_first(c),
        change=lambda c: c.recipe.configured(windows=round(2 * c.recipe.number("windows", 240))),
        hypothesis="The equations were fitted to some of the training windows: more windows reduce "
        "the variance.",
        expected="A higher training error and a lower V.",
    ),
    Move(
        name="equations alone",
        evidence=lambda c: bool(c.recipe.get("network")),
        change=_without_network,
        hypothesis="The equations with a few sparse linear terms may suffice: the network may fit "
        "the noise of its fold.",
        expected="A higher training error; V near or below the network's.",
    ),
    Move(
        name="slow disturbance",
        evidence=lambda c: not c.recipe.get("disturbance"),
        change=lambda c: c.recipe.configured(disturbance=True),
        hypothesis="A slow unmeasured disturbance acts on the states (wind, a draining supply, a "
        "drift).",
        expected="A whiter residual late in the window.",
    ),
    Move(
        name="feed-forward residual",
        evidence=lambda c: (
            (LIKELY if _stops_by_score(c) else POSSIBLE) * (c.recipe.get("network") != "mlp")
        ),
        change=lambda c: _with_network(c.facts, c.recipe, "mlp"),
        hypothesis="The residual depends on the present states and inputs.",
        expected="Lower training error, V follows.",
    ),
    Move(
        name="recurrent residual",
        evidence=lambda c: (
            (LIKELY if _stops_by_score(c) else POSSIBLE)
            * (c.recipe.get("network") not in ("gru", "lstm"))
        ),
        change=lambda c: _with_network(c.facts, c.recipe, "gru"),
        hypothesis="The residual depends on the past as well: actuator delays, lagging flows.",
        expected="Lower training error, V follows.",
    ),
)

CARD = Card(
    (
        Family(
            name="physics_net",
            label="physics network",
            use="equations whose states are all measured, with learned terms and a parallel "
            "network",
            base=8,
            points=(("windows", 3),),
            timing=Timing(15.0, 5e-6),
            needs=frozenset({"physics", "measured"}),
            start=lambda _: Recipe(
                "physics_net",
                (("linear", True), ("sparsity", 3e-4), ("robust", 0.3), ("windows", 240)),
                LM,
                (("iterations", 15),),
            ),
            space=_space,
            small=(("iterations", 3),),
            methods=(partial(_with_network, kind="mlp"), partial(_with_network, kind="gru")),
            stopped_by_score=frozenset({LM}),
        ),
    ),
    _MOVES,
)
