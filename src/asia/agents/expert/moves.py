"""Moves of the expert on any family, on the settings that families share, and on networks."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

from asia.agents.expert.diagnosis import COURSE_MOVES, leading_maps
from asia.agents.library.methods import by_lbfgs, by_multiple_shooting, slow_noise
from asia.agents.library.move import LIKELY, POSSIBLE, Move, Situation
from asia.agents.library.registry import all_cards
from asia.agents.library.trial_evidence import coloured, input_left, overfit
from asia.recipe import GRADIENT, Recipe


def _in_full(at: Situation) -> Recipe:
    """Apply the additional settings of the family's long fit to the present recipe."""
    trial, full = at.row.trial(at.facts), at.row.full(at.facts)
    config = {name: value for name, value in full.config if trial.get(name) != value}
    options = {name: value for name, value in full.options if trial.get(name) != value}
    return at.recipe.configured(**config).trained(**options)


def _fewer(at: Situation) -> Recipe:
    recipe = at.recipe
    for name, share, least in (("steps", 0.25, 50), ("iterations", 0.5, 5), ("starts", 0.5, 1)):
        if recipe.has(name):
            recipe = recipe.trained(**{name: max(least, round(share * recipe.number(name, 1)))})
    return recipe


def _order(at: Situation) -> int:
    """Return the states of the model: where the fit chooses, those that it reports, or else those
    of the first trial that reports any."""
    chosen = [t.order for t in (at.trial, *at.view.trials) if t.order is not None]
    return round(at.recipe.number("order", chosen[0] if chosen else 2))


GENERAL_MOVES: tuple[Move, ...] = (
    Move(
        name="fitted in full",
        evidence=lambda c: (
            LIKELY * (c.recipe.number("steps", 0) < c.row.full(c.facts).number("steps", 0))
        ),
        change=_in_full,
        hypothesis="The first fit of a network is short and may not have converged.",
        expected="Lower training error, V follows.",
    ),
    Move(
        name="one state more",
        evidence=lambda c: (
            (LIKELY if coloured(c.trial) else POSSIBLE)
            * c.varies("order")
            * (_order(c) < 6 and not c.recipe.get("regularised"))
        ),
        change=lambda c: c.recipe.configured(order=_order(c) + 1),
        hypothesis="The residual is not white: a mode is missing.",
        expected="A whiter residual and a lower V.",
    ),
    Move(
        name="a shorter fit",
        evidence=lambda c: LIKELY * (c.trial.status == "timeout"),
        change=_fewer,
        hypothesis="The fit exceeded its time limit: fewer steps still give a value for the "
        "family.",
        expected="A value for this family, to compare with the others.",
        after="failure",
    ),
)


def _map_move(name: str, setting: str, kind: str, hypothesis: str) -> Move:
    """Make the move that puts a static function before or after the model; a diagnosis leads to it,
    see `asia.agents.expert.diagnosis.ANSWERS`."""
    return Move(
        name=name,
        # Of the functions in place of another one only the rising one is more general.
        evidence=lambda c: (
            c.recipe.get(setting) != kind and (kind == "monotone" or c.recipe.get(setting) is None)
        ),
        change=lambda c: c.recipe.mapped(**{setting: kind}),
        hypothesis=hypothesis,
        expected="A far lower V; the residual no longer depends on the amplitude.",
    )


MAP_MOVES: tuple[Move, ...] = (
    _map_move(
        "saturated inputs", "input_map", "saturation",
        "The residual depends on the amplitude: the actuator has a lower and an upper limit.",
    ),
    _map_move(
        "rising function of the inputs", "input_map", "monotone",
        "The residual depends on the amplitude: the actuator follows a curve.",
    ),
    _map_move(
        "dead zone of the inputs", "input_map", "dead_zone",
        "The residual depends on the amplitude: small inputs do nothing.",
    ),
    _map_move(
        "rising function of the outputs", "output_map", "monotone",
        "The residual depends on the amplitude: the sensor follows a curve.",
    ),
    _map_move(
        "sensor without sign", "output_map", "magnitude",
        "The outputs are never negative and touch zero: the sensor gives the magnitude.",
    ),
    _map_move(
        "sensor of squares", "output_map", "square",
        "The outputs are never negative and touch zero: the sensor gives the square.",
    ),
    Move(
        name="static functions of the leader",
        evidence=lambda c: LIKELY * bool(leading_maps(c.view) and not c.recipe.maps),
        change=lambda c: c.recipe.mapped(**dict(leading_maps(c.view))),
        hypothesis="Static functions of inputs or outputs lead in another family.",
        expected="A far lower V.",
    ),
)  # fmt: skip

_SIZES = ("hidden", "width", "units", "states", "slow")
_SLOW_NOISE = slow_noise()


def _network(at: Situation) -> bool:
    return at.recipe.method in GRADIENT


def _sizes(at: Situation) -> dict[str, float]:
    """Settings that hold numbers of units, whichever the family names so."""
    sizes = {name: at.recipe.number(name, 0) for name in _SIZES}
    return {name: size for name, size in sizes.items() if size > 0}


def _wider(at: Situation) -> Recipe:
    return at.recipe.configured(**{name: round(2 * size) for name, size in _sizes(at).items()})


def _depth(at: Situation) -> str:
    return next((n for n in ("layers", "depth") if at.recipe.number(n, 0) > 0), "")


NETWORK_MOVES: tuple[Move, ...] = (
    replace(
        _SLOW_NOISE,
        # Cards of other families have a move of their own.
        evidence=lambda c: _SLOW_NOISE.evidence(c) * (c.recipe.method in ("Adam", "LBFGS")),
    ),
    Move(
        name="symmetries of the signals",
        evidence=lambda c: (
            LIKELY
            * any(p.name == "symmetry" for p in c.row.space(c.facts).options)
            * (not c.recipe.get("symmetry"))
        ),
        change=lambda c: c.recipe.trained(symmetry=True),
        hypothesis="The problem lists transformations of its signals that leave the system "
        "unchanged. A network trained on the transformed records and averaged over them has this "
        "symmetry built in.",
        expected="A lower V; the training error may rise.",
    ),
    Move(
        name="squares of the inputs",
        evidence=lambda c: (
            (LIKELY if input_left(c.trial) else POSSIBLE)
            * c.varies("features")
            * (not c.recipe.get("features"))
        ),
        change=lambda c: c.recipe.configured(features=("square",)),
        hypothesis="Actuators often act with the square of the command (thrust, drag, power): a "
        "network with squared inputs need not learn the squares.",
        expected="Lower training error and lower V, most where the input varies widely.",
    ),
    Move(
        name="average of several seeds",
        evidence=lambda c: (
            (LIKELY if overfit(c.trial) > 2.0 else POSSIBLE)
            * (_network(c) and c.row.seeds and not c.recipe.get("members"))
        ),
        change=lambda c: c.recipe.trained(members=3),
        hypothesis="Networks from different seeds have different errors; their mean has less "
        "error.",
        expected="A lower and steadier V at the same training error.",
    ),
    Move(
        name="wider network",
        evidence=lambda c: _network(c) and 0 < max(_sizes(c).values(), default=0.0) < 128,
        change=_wider,
        hypothesis="The training error is not much below V: the model is too small.",
        expected="Lower training error, V follows.",
    ),
    Move(
        name="deeper network",
        evidence=lambda c: _network(c) and bool(_depth(c)),
        change=lambda c: c.recipe.configured(
            **{_depth(c): round(c.recipe.number(_depth(c), 1)) + 1}
        ),
        hypothesis="One layer may be too small for the interaction of the inputs.",
        expected="Lower training error, V follows.",
    ),
    Move(
        name="scheduled sampling",
        evidence=lambda c: c.varies("teacher") and c.recipe.number("teacher", 0) < 1,
        change=lambda c: c.recipe.trained(teacher=1.0, teacher_end=0.0),
        hypothesis="A model with output feedback trains faster when it first receives the measured "
        "output (teacher forcing), with a rate that decreases in steps.",
        expected="Lower training error, V follows.",
    ),
    Move(
        name="L-BFGS on all samples",
        evidence=lambda c: (
            c.recipe.method == "Adam" and by_lbfgs in c.row.methods and c.facts.fit_samples <= 5_000
        ),
        change=lambda c: by_lbfgs(c.facts, c.recipe),
        hypothesis="On a short record second-order steps in double precision converge further than "
        "Adam.",
        expected="A markedly lower training error; V follows if the model is small enough.",
    ),
    Move(
        name="multiple shooting",
        evidence=lambda c: c.recipe.method == "Adam" and by_multiple_shooting in c.row.methods,
        change=lambda c: by_multiple_shooting(c.facts, c.recipe),
        hypothesis="Gradients through long simulations are the problem: short segments with free "
        "initial states, joined by a penalty, fit the same model.",
        expected="Lower training error where whole simulations were hard to fit.",
    ),
)


@cache
def all_moves() -> tuple[Move, ...]:
    """The moves of the cards, then those on any family, on static functions and on networks. Of two
    with the same evidence the first is made."""
    of_cards = (move for card in all_cards() for move in card.own_moves())
    return (*of_cards, *GENERAL_MOVES, *MAP_MOVES, *NETWORK_MOVES, *COURSE_MOVES)
