"""Training methods: suitable settings of each for a problem, and their search spaces."""

from asia.agents.library.family import CHUNK, FEWEST_STEPS, SampleCost, Stage, steps
from asia.agents.library.move import LIKELY, POSSIBLE, Move, Situation
from asia.agents.library.space import OneOf, Parameter, Span
from asia.agents.library.traits import traits
from asia.agents.library.trial_evidence import coloured
from asia.agents.view import Facts
from asia.data.statistics import integrating
from asia.recipe import Arguments, Recipe

LM = "LevenbergMarquardt"
_LARGE_BATCH = 384
# So many samples are too many for batches of 128 to give a quiet gradient.
_MANY_SAMPLES = 20_000
# Windows at least so long are worth a loss at several horizons.
_LEAST_HORIZON = 10


def adam(facts: Facts, cost: SampleCost, stage: Stage, learning_rate: float) -> Arguments:
    """Settings of Adam: all windows in batches, or chunks of whole records; the metric as loss
    where it is the absolute error."""
    chunks: Arguments = (("truncation", CHUNK),) if facts.horizon is None else ()
    return (
        ("steps", steps(facts, cost, stage)),
        ("learning_rate", learning_rate),
        ("weight_decay", 1e-4),
        *chunks,
        *absolute_loss(facts),
    )


def absolute_loss(facts: Facts) -> Arguments:
    """The absolute error as loss where it is the metric, else the method's own loss."""
    return () if facts.loss == "mse" else (("loss", facts.loss),)


def symmetry_space(facts: Facts) -> tuple[Parameter, ...]:
    """Return whether a model without equations is given the symmetries of its signals, where
    declared."""
    return (OneOf("symmetry", (False, True)),) if "symmetric" in traits(facts) else ()


def adam_space(facts: Facts, needs: str = "") -> tuple[Parameter, ...]:
    """Adam's settings but the number of steps."""
    found: list[Parameter] = [
        Span("learning_rate", 3e-4, 1e-2, needs=needs),
        Span("weight_decay", 1e-6, 1e-1, needs=needs),
        OneOf("noise", (0.0, 0.05, 0.1), needs=needs),
        OneOf("dropout", (0.0, 0.1), needs=needs),
        OneOf("schedule", ("cosine", "plateau"), needs=needs),
        OneOf("average", (0.0, 0.99), needs=needs),
        OneOf("loss", (facts.loss, "mse" if facts.loss == "huber" else "huber"), needs=needs),
    ]
    found.extend(noise_space(facts, with_loss=True))
    if facts.early_stopping == "inner":
        found.append(OneOf("holdout", (0.0, 0.2), needs=needs))
    if facts.fit_samples > _MANY_SAMPLES:
        found.append(OneOf("batch", (None, _LARGE_BATCH), needs=needs))
    if facts.horizon is None:
        found.append(OneOf("truncation", (64, 128, 256), needs=needs))
    elif facts.horizon >= _LEAST_HORIZON:
        found.append(OneOf("horizons", (None, several_horizons(facts)), needs=needs))
    return tuple(found)


def several_horizons(facts: Facts) -> tuple[int, ...]:
    """A tenth, a third and all of the window, in samples."""
    horizon = facts.horizon or 0
    return tuple(sorted({max(1, horizon // 10), max(1, horizon // 3), horizon}))


def by_lbfgs(facts: Facts, recipe: Recipe) -> Recipe:
    """The same model fitted by L-BFGS on all samples at once."""
    loss = "mse" if facts.loss == "mse" else "huber"
    updates = max(FEWEST_STEPS, round(recipe.number("steps", 2000)) // 10)
    options: Arguments = (("steps", updates), ("ridge", 1e-5), ("loss", loss))
    return recipe.fitted_by("LBFGS", (*options, *_kept_symmetry(recipe)))


def by_multiple_shooting(facts: Facts, recipe: Recipe) -> Recipe:
    """The same model fitted by multiple shooting."""
    options: Arguments = (
        ("steps", round(recipe.number("steps", 2000))),
        ("learning_rate", recipe.number("learning_rate", 3e-3)),
        ("length", 30 if facts.horizon is None else max(2, facts.horizon // 3)),
        *absolute_loss(facts),
        *_kept_symmetry(recipe),
    )
    return recipe.fitted_by("MultipleShooting", options)


def _kept_symmetry(recipe: Recipe) -> Arguments:
    symmetry = dict(recipe.options).get("symmetry")
    return (("symmetry", symmetry),) if symmetry else ()


def noise_space(facts: Facts, *, with_loss: bool = False) -> tuple[Parameter, ...]:
    """Settings of a training method where whole records are simulated: windows are too short to
    tell a slow disturbance from their start. `with_loss`: the method has a loss, which must be the
    squared error."""
    if facts.horizon is not None:
        return ()
    needs, being = ("loss", "mse") if with_loss else ("", None)
    return (OneOf("noise_model", ("white", "slow"), needs=needs, being=being),)


def has_noise_model(recipe: Recipe) -> bool:
    """Return whether the fit takes a slow disturbance into account."""
    return recipe.get("noise_model") == "slow"


def integrator_setting(facts: Facts) -> Arguments:
    """Return the setting for as many free integrators as outputs show; no setting without them."""
    found = len(integrating(facts.records)) if "integrating" in traits(facts) else 0
    return (("integrators", found),) if found else ()


def integrator_moves() -> tuple[Move, ...]:
    """One integrator more, and none."""
    return (
        Move(
            name="one free integrator more",
            evidence=lambda c: (0 < c.recipe.number("integrators", 0) < 2) * coloured(c.trial),
            change=lambda c: c.recipe.configured(
                integrators=round(c.recipe.number("integrators", 0)) + 1
            ),
            hypothesis="The output drifts with the sum of the input, and its driving state may "
            "drift as well: a force on a mass without a spring integrates twice.",
            expected="A lower error late in the simulation, on every fold.",
        ),
        Move(
            name="without a free integrator",
            evidence=lambda c: c.recipe.number("integrators", 0) > 0,
            change=lambda c: c.recipe.without("integrators"),
            hypothesis="The free integrator may be a slow stable mode.",
            expected="A lower V if it does.",
        ),
    )


def from_pieces(**also: bool) -> Move:
    """Make the move to fit state-space models first to segments of the records.

    Args:
        also: further settings
    """

    def evidence(at: Situation) -> int:
        if at.facts.horizon is not None or at.recipe.get("pieces"):
            return 0
        return LIKELY if coloured(at.trial) else POSSIBLE

    return Move(
        name="fit from pieces",
        evidence=evidence,
        change=lambda c: c.recipe.configured(pieces=True, **also),
        hypothesis="The residual is coloured and the fit may be in a local minimum: short segments "
        "of the records, each with its own initial state, have fewer.",
        expected="A lower training error, V follows.",
    )


def slow_noise() -> Move:
    """Generalised least squares in place of least squares."""

    def evidence(at: Situation) -> int:
        squared = at.recipe.get("loss") in (None, "mse")
        if has_noise_model(at.recipe) or not at.varies("noise_model") or not squared:
            return 0
        return LIKELY if coloured(at.trial) else POSSIBLE

    return Move(
        name="slow disturbance in the noise",
        evidence=evidence,
        change=lambda c: c.recipe.trained(noise_model="slow"),
        hypothesis="The training residual is not white: the output contains a slow unmeasured "
        "disturbance, which biases a least-squares fit. Generalised least squares avoids this "
        "bias.",
        expected="A higher training error and a lower V, with parameters that agree between folds.",
    )
