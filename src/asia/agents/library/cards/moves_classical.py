"""Moves on state-space models and others with few parameters."""

from __future__ import annotations

from asia.agents.expert.evidence import coloured, curved, overfit, plateau_share
from asia.agents.expert.move import Case, Move
from asia.agents.library.recipe import Recipe

STATE = ("neural_ss",)
RIDGED = (*STATE, "block_oriented", "hybrid")
_STANDS_STILL = 0.02


def _order(case: Case) -> int:
    return round(case.recipe.number("order", 2))


def _ridge(case: Case, factor: float) -> Recipe:
    return case.recipe.times("ridge", factor, 1e-5)


def _nonlinearity(case: Case, wanted: str, weight: float) -> float:
    return 0.0 if case.recipe.get("nonlinearity") == wanted else weight


def _at(case: Case, place: str) -> Recipe:
    """The static function elsewhere; channels belong to one in the state equation."""
    recipe = case.recipe.configured(nonlinearity=place)
    return recipe.configured(channels=None) if recipe.has("channels") else recipe


def _structure(case: Case, wanted: str, weight: float) -> float:
    return 0.0 if case.recipe.get("structure") == wanted else weight


def _over(case: Case, far: float, some: float, none: float) -> float:
    ratio = overfit(case.trial)
    return far if ratio > 2.0 else some if ratio > 1.3 else none


CLASSICAL_MOVES: tuple[Move, ...] = (
    Move(
        name="more ridge",
        families=RIDGED,
        weight=lambda c: _over(c, 0.75, 0.45, 0.1),
        change=lambda c: _ridge(c, 10.0),
        hypothesis="V is well above the training error: the weights follow their own fold.",
        expected="A slightly higher training error and a lower V.",
    ),
    Move(
        name="much more ridge",
        families=(*STATE, "block_oriented"),
        weight=lambda c: _over(c, 0.85, 0.5, 0.1),
        change=lambda c: _ridge(c, 30.0),
        hypothesis="V is well above the training error: the nonlinear weights follow their own "
        "fold, or run away outside it.",
        expected="A higher training error and a lower V.",
    ),
    Move(
        name="less ridge",
        families=RIDGED,
        weight=lambda c: 0.5 if overfit(c.trial) < 1.3 else 0.15,
        change=lambda c: _ridge(c, 0.1),
        hypothesis="V is near the training error: the priors hold the model back.",
        expected="Lower training error, V follows.",
    ),
    Move(
        name="median of several fits",
        families=STATE,
        weight=lambda c: 0 if c.recipe.get("members") else 0.55,
        change=lambda c: c.recipe.configured(members=3).trained(starts=4),
        hypothesis="Fits from different starts err differently; their median errs less.",
        expected="A lower and steadier V at the same training error.",
    ),
    Move(
        name="more starts",
        families=(),
        weight=lambda c: 0.25 * (0 < c.recipe.number("starts", 0) <= 16),
        change=lambda c: c.recipe.trained(starts=round(2 * c.recipe.number("starts", 1))),
        hypothesis="The best of the starting points may not be the best there is.",
        expected="The same or a lower training error.",
    ),
    Move(
        name="static function at the output",
        families=STATE,
        weight=lambda c: _nonlinearity(c, "output", 0.8 if curved(c.trial) else 0.7),
        change=lambda c: _at(c, "output"),
        hypothesis="The system may be linear with a static function after it (Wiener): fewer "
        "weights say the same.",
        expected="A lower V at the same training error, if the structure is right.",
    ),
    Move(
        name="static function at the input",
        families=STATE,
        weight=lambda c: _nonlinearity(c, "input", 0.7),
        change=lambda c: _at(c, "input"),
        hypothesis="The system may be linear with a static function before it (Hammerstein).",
        expected="A lower V at the same training error, if the structure is right.",
    ),
    Move(
        name="static functions on both sides",
        families=STATE,
        weight=lambda c: _nonlinearity(c, "both", 0.6),
        change=lambda c: _at(c, "both"),
        hypothesis="Static functions before and after a linear system (Hammerstein-Wiener).",
        expected="A lower V than either alone, if the structure is right.",
    ),
    Move(
        name="static function in feedback",
        families=STATE,
        weight=lambda c: (
            0.5 * (c.recipe.get("nonlinearity") == "state") * (not c.recipe.get("channels"))
        ),
        change=lambda c: c.recipe.configured(channels=1),
        hypothesis="One signal goes through one static function and back into a linear system (a "
        "hardening spring, a saturating actuator in a loop): fewer weights say the same.",
        expected="A lower V at the same training error, if the structure is right.",
    ),
    Move(
        name="static function before the system",
        families=("block_oriented",),
        weight=lambda c: _structure(c, "hammerstein", 0.45),
        change=lambda c: c.recipe.configured(structure="hammerstein"),
        hypothesis="The actuator bends, all else is linear (Hammerstein).",
        expected="A lower V at the same training error, if the structure is right.",
    ),
    Move(
        name="static function after the system",
        families=("block_oriented",),
        weight=lambda c: _structure(c, "wiener", 0.45),
        change=lambda c: c.recipe.configured(structure="wiener"),
        hypothesis="The sensor bends, all else is linear (Wiener).",
        expected="A lower V at the same training error, if the structure is right.",
    ),
    Move(
        name="output kept inside its range",
        families=("narx", "gp_narx"),
        weight=lambda c: (
            (0.7 if plateau_share(c.facts) > _STANDS_STILL else 0.35)
            * (c.recipe.number("margin", 0.1) > 0)
        ),
        change=lambda c: c.recipe.configured(margin=0.0),
        hypothesis="The output has a limit that it reaches in the records: the model must not pass "
        "it either.",
        expected="A lower V where the output stands still.",
    ),
    Move(
        name="terms up to the third degree",
        families=("narx",),
        weight=lambda c: (0.4 if curved(c.trial) else 0.25) * (c.recipe.number("degree", 2) < 3),
        change=lambda c: c.recipe.configured(degree=3),
        hypothesis="The nonlinearity is not even.",
        expected="A lower training error, V follows.",
    ),
    Move(
        name="firmer coefficients",
        families=("narx",),
        weight=lambda c: _over(c, 0.6, 0.4, 0.2),
        change=lambda c: c.recipe.times("coefficient_ridge", 30.0, 1e-5),
        hypothesis="The refinement of the coefficients follows its own fold.",
        expected="A higher training error and a lower V.",
    ),
    Move(
        name="larger reservoir",
        families=("esn",),
        weight=lambda c: 0.35 * (c.recipe.number("units", 0) < 1000),
        change=lambda c: c.recipe.configured(units=round(2 * c.recipe.number("units", 300))),
        hypothesis="A larger reservoir holds more functions of the past for the readout.",
        expected="Lower training error, V follows.",
    ),
    Move(
        name="one state more",
        families=(*STATE, "block_oriented", "linear"),
        weight=lambda c: (0.6 if coloured(c.trial) else 0.3) * (_order(c) < 6),
        change=lambda c: c.recipe.configured(order=_order(c) + 1),
        hypothesis="The residual is not white: a mode is missing.",
        expected="A whiter residual and a lower V.",
    ),
)
