"""The model library as the built-in agents know it: one row a family, with where to start and what
may be varied. `expert` and `random` search the same rows."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from asia.agents._recipe import Recipe, Value
from asia.agents._view import Facts

Choices = tuple[tuple[str, tuple[Value, ...]], ...]
_FULL_STEPS = 3000
_SHORT_RECORD = 600


@dataclass(frozen=True)
class Family:
    """A row of the library. `use` is when to reach for it; `start` the first configuration;
    `config` and `options` list what a random draw may take."""

    name: str
    label: str
    use: str
    start: Callable[[Facts], Recipe]
    config: Callable[[Facts], Choices]
    options: Choices
    needs_physics: bool = False

    def suits(self, facts: Facts) -> bool:
        """Whether the family can be used on the problem at all."""
        return facts.physics is not None or not self.needs_physics


def steps(facts: Facts) -> int:
    """Adam steps that keep the cost of a fit level as records grow."""
    return max(500, min(_FULL_STEPS, _FULL_STEPS * _SHORT_RECORD // max(facts.samples // 2, 1)))


def families(facts: Facts) -> tuple[Family, ...]:
    """The rows that suit a problem, in the order a careful engineer would try them."""
    return tuple(row for row in FAMILIES if row.suits(facts))


def family(name: str) -> Family | None:
    """A row by name."""
    return next((row for row in FAMILIES if row.name == name), None)


def state_sets(facts: Facts) -> tuple[tuple[str, ...], ...]:
    """Single states and all of them together, for settings that name states."""
    states = facts.physics.states if facts.physics else ()
    single = tuple((s,) for s in states)
    return (*single, states) if len(states) > 1 else single


def _greybox_choices(facts: Facts) -> Choices:
    return (
        ("saturation", ((), *state_sets(facts))),
        ("spill", (False, True)),
        ("linear", (False, True)),
        ("offset", ((), *state_sets(facts)[-1:])),
        ("residual", (0, 4)),
        ("ridge", (1e-4, 1e-3, 1e-2, 1e-1)),
    )


LM = "LevenbergMarquardt"

FAMILIES: tuple[Family, ...] = (
    Family(
        name="greybox",
        label="grey-box",
        use="the person's own equations, fitted in physical units",
        start=lambda _: Recipe("greybox", (), LM, (("iterations", 60), ("starts", 8))),
        config=_greybox_choices,
        options=(("iterations", (40, 80)), ("starts", (4, 8, 16))),
        needs_physics=True,
    ),
    Family(
        name="linear",
        label="linear state-space",
        use="how far a linear model goes, and the start of the nonlinear ones",
        start=lambda _: Recipe(
            "linear", (("order", None), ("delay", None)), LM, (("iterations", 30),)
        ),
        config=lambda _: (("order", (None, 1, 2, 3, 4, 5, 6)), ("delay", (0, None))),
        options=(("iterations", (15, 30, 60)),),
    ),
    Family(
        name="neural_ss",
        label="neural state-space",
        use="a linear model with small static nonlinearities, for short records",
        start=lambda _: Recipe(
            "neural_ss",
            (("nonlinearity", "state"), ("hidden", 8), ("delay", None)),
            LM,
            (("iterations", 60), ("starts", 2)),
        ),
        config=lambda _: (
            ("order", (None, 2, 3, 4)),
            ("nonlinearity", ("state", "input", "output", "both")),
            ("hidden", (4, 8, 12)),
            ("ridge", (1e-6, 1e-5, 1e-4, 1e-3, 1e-2)),
            ("delay", (0, None)),
        ),
        options=(("iterations", (40, 80)), ("starts", (1, 2, 4))),
    ),
    Family(
        name="ltc",
        label="LTC network",
        use="states that decay with learned time constants: dissipative systems",
        start=lambda facts: Recipe(
            "ltc",
            (("hidden", 64),),
            "Adam",
            (("steps", steps(facts)), ("learning_rate", 1e-3), ("truncation", 128)),
        ),
        config=lambda _: (("hidden", (8, 16, 32, 64)), ("tau_max", (10.0, 25.0, 100.0))),
        options=(
            ("steps", (1000, 2000)),
            ("learning_rate", (1e-3, 3e-3)),
            ("weight_decay", (0.0, 1e-4, 1e-2)),
            ("truncation", (64, 128, 256)),
            ("noise", (0.0, 0.1)),
        ),
    ),
    Family(
        name="hybrid",
        label="hybrid",
        use="the person's equations with a learned residual",
        start=lambda _: Recipe("hybrid", (("units", 4),), LM, (("iterations", 60), ("starts", 8))),
        config=lambda _: (("units", (2, 4, 8)), ("ridge", (1e-3, 1e-2, 1e-1))),
        options=(("iterations", (40, 80)), ("starts", (4, 8))),
        needs_physics=True,
    ),
    Family(
        name="recurrent",
        label="recurrent network",
        use="a general gated network, when nothing is known of the system",
        start=lambda facts: Recipe(
            "recurrent",
            (("cell", "gru"), ("hidden", 16)),
            "Adam",
            (("steps", steps(facts)), ("learning_rate", 3e-3), ("truncation", 128)),
        ),
        config=lambda _: (
            ("cell", ("rnn", "gru", "lstm")),
            ("hidden", (8, 16, 32)),
            ("layers", (1, 2)),
        ),
        options=(
            ("steps", (1000, 2000)),
            ("learning_rate", (1e-3, 3e-3, 1e-2)),
            ("weight_decay", (0.0, 1e-4, 1e-2)),
            ("truncation", (128, 256)),
            ("noise", (0.0, 0.1)),
        ),
    ),
)
