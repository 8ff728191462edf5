"""Moves of the expert on any family, on the settings that families share, and on networks."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING

from asia.agents.expert.diagnosis import COURSE_MOVES, leading_maps
from asia.agents.library.family import is_new
from asia.agents.library.methods import (
    LARGE_BATCH,
    LEAST_HORIZON,
    MANY_SAMPLES,
    TRANSIENT,
    by_lbfgs,
    by_multiple_shooting,
    has_noise_model,
    several_horizons,
    slow_noise,
)
from asia.agents.library.move import Move, Situation, plain_title
from asia.agents.library.recipe import GRADIENT, Recipe, read_recipe
from asia.agents.library.registry import all_cards
from asia.agents.library.space import Span
from asia.agents.library.traits import traits
from asia.agents.library.trial_evidence import coloured, input_left, overfit

if TYPE_CHECKING:
    from optuna.distributions import BaseDistribution

    from asia.agents.view import Trial

# Tuning the leading recipe by a tree-structured Parzen estimator (Bergstra, Bardenet,
# Bengio and Kegl, NeurIPS 2011). Optuna's study lives in memory and is rebuilt from the ledger's
# trials at each proposal, so that a proposal is a function of the view.

TUNED = "numbers tuned"

# The length of a fit determines its cost: moves change it, tuning does not.
_EFFORT = frozenset({"steps", "iterations", "starts", "members", "truncation"})


def may_tune(at: Situation) -> bool:
    """Return whether the leading recipe has numbers to tune and the tuned experiments, at most a
    fifth of the budget, are not used up."""
    used = sum(plain_title(trial.title).endswith(f": {TUNED}") for trial in at.view.proposed)
    return used < 0.2 * at.view.experiments and bool(_spans(at))


def tuned(at: Situation) -> Recipe:
    """The recipe with numbers near the best ones, where the trials so far promise most; the
    recipe itself when nothing new was found."""
    import optuna
    from optuna.distributions import FloatDistribution

    optuna.logging.set_verbosity(optuna.logging.ERROR)
    word = f"tune:{at.view.seed}:{len(at.view.proposed)}"
    seed = int.from_bytes(hashlib.sha256(word.encode()).digest()[:4], "big")
    sampler = optuna.samplers.TPESampler(n_startup_trials=4, multivariate=True, seed=seed)
    study = optuna.create_study(sampler=sampler)
    spans = _spans(at)
    ranges: dict[str, BaseDistribution] = {
        span.name: FloatDistribution(*_range(at, span), log=True) for span in spans
    }
    for trial in at.view.trials:
        params = _parameters(at, trial, spans)
        if params is not None and trial.value is not None:
            study.add_trial(
                optuna.trial.create_trial(params=params, distributions=ranges, value=trial.value)
            )
    for _ in range(8):
        asked = study.ask(ranges).params
        recipe = at.recipe.changed(**{s.name: s.tidy(asked[s.name]) for s in spans})
        if is_new(at.view, at.row, recipe):
            return recipe
    return at.recipe


def _spans(at: Situation) -> tuple[Span, ...]:
    spans = at.row.space(at.facts).spans(at.recipe)
    return tuple(span for span in spans if span.name not in _EFFORT)


def _parameters(at: Situation, trial: Trial, spans: tuple[Span, ...]) -> dict[str, float] | None:
    """A trial's numbers; None when it differs from the leading one in more, or lies too far."""
    recipe = read_recipe(trial.source)
    if recipe is None or not all(recipe.has(span.name) for span in spans):
        return None
    if recipe.changed(**{s.name: at.recipe.get(s.name) for s in spans}).key != at.recipe.key:
        return None
    numbers = {span.name: recipe.number(span.name, 0.0) for span in spans}
    for span in spans:
        low, high = _range(at, span)
        if not low <= numbers[span.name] <= high:
            return None
    return numbers


def _range(at: Situation, span: Span) -> tuple[float, float]:
    """Return a range of a factor of three to each side of the leading recipe's number, limited to
    the library's range extended to that number."""
    centre = at.recipe.number(span.name, span.low)
    low, high = max(span.low, centre / 3.0), min(span.high, centre * 3.0)
    return min(low, centre), max(high, centre)


def _full_weight(at: Situation) -> float:
    """Return the weight of a long fit, which may halve the error of a short one, hardly more."""
    best, value = at.view.best, at.trial.value
    behind = value / best.value if best is not None and best.value and value is not None else 1.0
    is_in_best_third = 3 * at.place < at.families
    full = at.row.full(at.facts).number("steps", 0)
    if not is_in_best_third or behind >= 2.0 or at.recipe.number("steps", 0) >= full:
        return 0.0
    return 0.85 if at.place == 0 else 0.7


def _in_full(at: Situation) -> Recipe:
    """Apply the additional settings of the family's long fit to the present recipe."""
    trial, full = at.row.trial(at.facts), at.row.full(at.facts)
    config = {name: value for name, value in full.config if trial.get(name) != value}
    options = {name: value for name, value in full.options if trial.get(name) != value}
    return at.recipe.configured(**config).trained(**options)


def _tuning_weight(at: Situation) -> float:
    """Return a weight above that of repeated small moves; near the end of the budget, above medium
    ones."""
    if at.place > 0 or not may_tune(at):
        return 0.0
    return 0.5 if at.view.remaining <= 0.25 * at.view.experiments else 0.3


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
        weight=_full_weight,
        change=_in_full,
        hypothesis="The short trial is among the best third, which justifies a long fit.",
        expected="Lower training error, V follows.",
        behind_counts=False,
    ),
    Move(
        name=TUNED,
        weight=_tuning_weight,
        change=tuned,
        hypothesis="The remaining gain lies in the hyperparameters: within a factor of three of "
        "the best ones, where the outcomes so far make it most likely (tree-structured Parzen "
        "estimator).",
        expected="A small gain in V.",
        same_effort=True,
        fade=0.9,
    ),
    Move(
        name="a shorter fit",
        weight=lambda c: 0.5 * (c.trial.status == "timeout"),
        change=_fewer,
        hypothesis="The fit exceeded its time limit: fewer steps still give a value for the "
        "family.",
        expected="A value for this family, to compare with the others.",
        after="failure",
        behind_counts=False,
    ),
    Move(
        name="a calmer fit",
        weight=lambda c: (
            0.4 * (c.trial.status == "invalid") * (c.recipe.number("learning_rate", 0) > 0)
        ),
        change=lambda c: c.recipe.times("learning_rate", 0.3, 1e-3),
        hypothesis="The simulation diverged: smaller steps keep it bounded.",
        expected="A value for this family, to compare with the others.",
        after="failure",
        behind_counts=False,
    ),
)

# Static functions around any family.


def _map_move(name: str, setting: str, kind: str, weight: float, hypothesis: str) -> Move:
    """Make the move that puts a static function before or after the model.

    Args:
        weight: weight without a diagnosis; `expert.diagnosis.ANSWERS` says what raises it
    """
    return Move(
        name=name,
        # Of the functions in place of another one only the rising one is more general.
        weight=lambda c: (
            weight
            * (c.recipe.get(setting) != kind)
            * (kind == "monotone" or c.recipe.get(setting) is None)
        ),
        change=lambda c: c.recipe.mapped(**{setting: kind}),
        hypothesis=hypothesis,
        expected="A far lower V; the residual no longer depends on the amplitude.",
    )


MAP_MOVES: tuple[Move, ...] = (
    _map_move(
        "saturated inputs", "input_map", "saturation", 0.2,
        "The residual depends on the amplitude: the actuator has a lower and an upper limit.",
    ),
    _map_move(
        "rising function of the inputs", "input_map", "monotone", 0.15,
        "The residual depends on the amplitude: the actuator follows a curve.",
    ),
    _map_move(
        "dead zone of the inputs", "input_map", "dead_zone", 0.1,
        "The residual depends on the amplitude: small inputs do nothing.",
    ),
    _map_move(
        "rising function of the outputs", "output_map", "monotone", 0.1,
        "The residual depends on the amplitude: the sensor follows a curve.",
    ),
    _map_move(
        "sensor without sign", "output_map", "magnitude", 0.01,
        "The outputs are never negative and touch zero: the sensor gives the magnitude.",
    ),
    _map_move(
        "sensor of squares", "output_map", "square", 0.01,
        "The outputs are never negative and touch zero: the sensor gives the square.",
    ),
    Move(
        name="static functions of the leader",
        weight=lambda c: 0.75 * bool(leading_maps(c.view) and not c.recipe.maps),
        change=lambda c: c.recipe.mapped(**dict(leading_maps(c.view))),
        hypothesis="Static functions of inputs or outputs lead in another family.",
        expected="A far lower V.",
        behind_counts=False,
    ),
)  # fmt: skip

SETTING_MOVES: tuple[Move, ...] = (
    Move(
        name="more starts",
        weight=lambda c: 0.25 * (0 < c.recipe.number("starts", 0) <= 16),
        change=lambda c: c.recipe.trained(starts=round(2 * c.recipe.number("starts", 1))),
        hypothesis="The best of the starting points may not lead to the global minimum.",
        expected="The same or a lower training error.",
    ),
    Move(
        name="one state more",
        weight=lambda c: (
            (0.6 if coloured(c.trial) else 0.3)
            * c.varies("order")
            * (_order(c) < 6 and not c.recipe.get("regularised"))
        ),
        change=lambda c: c.recipe.configured(order=_order(c) + 1),
        hypothesis="The residual is not white: a mode is missing.",
        expected="A whiter residual and a lower V.",
    ),
)


# Moves on networks: size, inputs, loss, optimiser, regularisation.


_SIZES = ("hidden", "width", "units", "states", "slow")


def _adam(at: Situation) -> bool:
    return at.recipe.method == "Adam"


def _network(at: Situation) -> bool:
    return at.recipe.method in GRADIENT


def _held_back(at: Situation, well: float, badly: float) -> float:
    """`badly` where the model knows its own fold far too well, `well` where it does not."""
    return badly if overfit(at.trial) > 2.0 else well


def _sizes(at: Situation) -> dict[str, float]:
    """Settings that hold numbers of units, whichever the family names so."""
    sizes = {name: at.recipe.number(name, 0) for name in _SIZES}
    return {name: size for name, size in sizes.items() if size > 0}


def _resized(at: Situation, factor: float) -> Recipe:
    sizes = {name: max(2, round(factor * size)) for name, size in _sizes(at).items()}
    return at.recipe.configured(**sizes)


def _widest(at: Situation) -> float:
    return max(_sizes(at).values(), default=0.0)


def _depth(at: Situation) -> str:
    return next((n for n in ("layers", "depth") if at.recipe.number(n, 0) > 0), "")


def _scaled(at: Situation, name: str, factor: float) -> Recipe:
    number = factor * at.recipe.number(name, 1e-3)
    return at.recipe.trained(**{name: float(f"{number:.2g}")})


def _absent(at: Situation, name: str) -> bool:
    return not at.recipe.get(name)


_SLOW_NOISE = slow_noise()

NETWORK_MOVES: tuple[Move, ...] = (
    replace(
        _SLOW_NOISE,
        # Cards of other families have a move of their own.
        weight=lambda c: _SLOW_NOISE.weight(c) * (c.recipe.method in ("Adam", "LBFGS")),
    ),
    Move(
        name="symmetries of the signals",
        weight=lambda c: (
            (0.7 if c.place == 0 else 0.5)
            * any(p.name == "symmetry" for p in c.row.space(c.facts).options)
            * _absent(c, "symmetry")
        ),
        change=lambda c: c.recipe.trained(symmetry=True),
        hypothesis="The problem lists transformations of its signals that leave the system "
        "unchanged. A network trained on the transformed records and averaged over them has this "
        "symmetry built in.",
        expected="A lower V; the training error may rise.",
    ),
    Move(
        name="squares of the inputs",
        weight=lambda c: (
            (0.6 if input_left(c.trial) else 0.4) * c.varies("features") * _absent(c, "features")
        ),
        change=lambda c: c.recipe.configured(features=("square",)),
        hypothesis="Actuators often act with the square of the command (thrust, drag, power): a "
        "network with squared inputs need not learn the squares.",
        expected="Lower training error and lower V, most where the input varies widely.",
    ),
    Move(
        name="average of several seeds",
        weight=lambda c: (
            _held_back(c, 0.4, 0.55) * _network(c) * c.row.seeds * _absent(c, "members")
        ),
        change=lambda c: c.recipe.trained(members=3),
        hypothesis="Networks from different seeds have different errors; their mean has less "
        "error.",
        expected="A lower and steadier V at the same training error.",
    ),
    Move(
        name="longer training",
        weight=lambda c: _held_back(c, 0.45, 0.1) * _network(c),
        change=lambda c: c.recipe.trained(steps=round(2 * c.recipe.number("steps", 1000))),
        hypothesis="The training error is not far below V and may still fall.",
        expected="Lower training error, V follows.",
    ),
    Move(
        name="wider network",
        weight=lambda c: _held_back(c, 0.45, 0.15) * _network(c) * (0 < _widest(c) < 128),
        change=lambda c: _resized(c, 2.0),
        hypothesis="The training error is not much below V: the model is too small.",
        expected="Lower training error, V follows.",
    ),
    Move(
        name="narrower network",
        weight=lambda c: _held_back(c, 0.2, 0.5) * _network(c) * (_widest(c) >= 8),
        change=lambda c: _resized(c, 0.5),
        hypothesis="V is well above the training error: there are too many weights.",
        expected="Higher training error, lower V.",
    ),
    Move(
        name="deeper network",
        weight=lambda c: _held_back(c, 0.35, 0.1) * _network(c) * bool(_depth(c)),
        change=lambda c: c.recipe.configured(
            **{_depth(c): round(c.recipe.number(_depth(c), 1)) + 1}
        ),
        hypothesis="One layer may be too small for the interaction of the inputs.",
        expected="Lower training error, V follows.",
    ),
    Move(
        name="noise on the inputs in training",
        weight=lambda c: (0.5 if overfit(c.trial) > 1.5 else 0.2) * _adam(c) * _absent(c, "noise"),
        change=lambda c: c.recipe.trained(noise=0.1),
        hypothesis="The network has memorised the input record: noise on the input makes it "
        "generalise.",
        expected="A higher training error and a lower V.",
    ),
    Move(
        name="more weight decay",
        weight=lambda c: (
            _held_back(c, 0.15, 0.45) * (c.recipe.method in ("Adam", "MultipleShooting"))
        ),
        change=lambda c: _scaled(c, "weight_decay", 10.0),
        hypothesis="V is well above the training error: the weights overfit their fold.",
        expected="Higher training error, lower V.",
    ),
    Move(
        name="dropout",
        weight=lambda c: _held_back(c, 0.1, 0.4) * _adam(c) * _absent(c, "dropout"),
        change=lambda c: c.recipe.trained(dropout=0.1),
        hypothesis="V is well above the training error: the units are co-adapted.",
        expected="Higher training error, lower V.",
    ),
    Move(
        name="steps picked on a held-out part",
        weight=lambda c: (
            _held_back(c, 0.1, 0.45)
            * _network(c)
            * _absent(c, "holdout")
            * (c.facts.early_stopping == "inner")
        ),
        change=lambda c: c.recipe.trained(holdout=0.2),
        hypothesis="V is well above the training error: training was too long, and a fifth of the "
        "samples, held out, gives the right length.",
        expected="Higher training error, lower V; no gain where records are short.",
    ),
    Move(
        name="lower learning rate",
        weight=lambda c: 0.3 * (c.recipe.number("learning_rate", 0) > 2e-4),
        change=lambda c: _scaled(c, "learning_rate", 0.4),
        hypothesis="The last steps may be too large for the narrow valley of the loss.",
        expected="A slightly lower training error, V follows.",
    ),
    Move(
        name="higher learning rate",
        weight=lambda c: (
            (0.35 if overfit(c.trial) < 1.3 else 0.15)
            * (0 < c.recipe.number("learning_rate", 0) < 8e-3)
        ),
        change=lambda c: _scaled(c, "learning_rate", 2.5),
        hypothesis="The number of steps is low for this learning rate: larger steps get further.",
        expected="A lower training error, V follows.",
    ),
    Move(
        name="average of the last weights",
        weight=lambda c: 0.35 * _adam(c) * _absent(c, "average"),
        change=lambda c: c.recipe.trained(average=0.99),
        hypothesis="Weights fluctuate around their optimum; their moving average is nearer to it.",
        expected="About the same training error and a steadier, lower V.",
    ),
    Move(
        name="loss at several horizons",
        weight=lambda c: (
            0.4 * _adam(c) * _absent(c, "horizons") * ((c.facts.horizon or 0) >= LEAST_HORIZON)
        ),
        change=lambda c: c.recipe.trained(horizons=several_horizons(c.facts)),
        hypothesis="Late samples have most of the error and early ones most of the information: a "
        "loss over several horizons fits the early ones first.",
        expected="Lower error early in the window, and later at its end.",
    ),
    Move(
        name="scheduled sampling",
        weight=lambda c: 0.5 * _adam(c) * c.varies("teacher") * (c.recipe.number("teacher", 0) < 1),
        change=lambda c: c.recipe.trained(teacher=1.0, teacher_end=0.0),
        hypothesis="A model with output feedback trains faster when it first receives the measured "
        "output (teacher forcing), with a rate that decreases in steps.",
        expected="Lower training error, V follows.",
    ),
    Move(
        name="longer chunks",
        weight=lambda c: 0.3 * _adam(c) * (0 < c.recipe.number("truncation", 0) < 512),
        change=lambda c: c.recipe.trained(truncation=round(2 * c.recipe.number("truncation", 128))),
        hypothesis="One chunk is too short to show the slow dynamics.",
        expected="Lower error late in the simulation.",
    ),
    Move(
        name="state carried between chunks",
        weight=lambda c: (
            0.3
            * (_adam(c) and c.recipe.number("truncation", 0) > 0 and c.varies("carry"))
            * _absent(c, "carry")
            * ("long" in traits(c.facts))
        ),
        change=lambda c: c.recipe.trained(carry=True),
        hypothesis="Chunks that start from their past window never show a long accumulation in the "
        "state: in order, with the state carried over (truncated back-propagation through time), "
        "they do.",
        expected="Lower error late in the simulation.",
    ),
    Move(
        name="transient left out",
        weight=lambda c: (
            0.2 * (_adam(c) and c.recipe.number("truncation", 0) > 0) * _absent(c, "washout")
        ),
        change=lambda c: c.recipe.trained(washout=TRANSIENT),
        hypothesis="The past window determines the initial state poorly: the error of the first "
        "samples of a chunk comes from its initial state and corrupts the gradient.",
        expected="A lower error after the initial transient.",
    ),
    Move(
        name="Huber loss",
        weight=lambda c: (
            0.2
            * _adam(c)
            * (c.recipe.get("loss", "mse") != "huber" and not has_noise_model(c.recipe))
        ),
        change=lambda c: c.recipe.trained(loss="huber"),
        hypothesis="A Huber loss counts small errors squared and large ones by their absolute "
        "value.",
        expected="About the same training error; less influence of a few outliers.",
    ),
    Move(
        name="larger batches",
        weight=lambda c: (
            0.3 * _adam(c) * _absent(c, "batch") * (c.facts.fit_samples > MANY_SAMPLES)
        ),
        change=lambda c: c.recipe.trained(batch=LARGE_BATCH),
        hypothesis="The gradient of a small batch is noisy at the end of training.",
        expected="Lower training error at the same number of steps.",
    ),
    Move(
        name="L-BFGS on all samples",
        weight=lambda c: (
            (0.4 if overfit(c.trial) < 2.0 else 0.15)
            * _adam(c)
            * (by_lbfgs in c.row.methods)
            * (c.facts.fit_samples <= 5_000)
        ),
        change=lambda c: by_lbfgs(c.facts, c.recipe),
        hypothesis="On a short record second-order steps in double precision converge further than "
        "Adam.",
        expected="A markedly lower training error; V follows if the model is small enough.",
    ),
    Move(
        name="multiple shooting",
        weight=lambda c: 0.25 * _adam(c) * (by_multiple_shooting in c.row.methods),
        change=lambda c: by_multiple_shooting(c.facts, c.recipe),
        hypothesis="Gradients through long simulations are the problem: short segments with free "
        "initial states, joined by a penalty, fit the same model.",
        expected="Lower training error where whole simulations were hard to fit.",
    ),
)


@cache
def all_moves() -> tuple[Move, ...]:
    """The moves on any family, those of the cards, and those that a family's settings allow. Of
    two with the same weight the first is made."""
    of_cards = (move for card in all_cards() for move in card.own_moves())
    return (*GENERAL_MOVES, *of_cards, *MAP_MOVES, *SETTING_MOVES, *NETWORK_MOVES, *COURSE_MOVES)
