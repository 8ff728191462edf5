"""Families of classical identification: few parameters, cheap fits."""

from __future__ import annotations

from asia.agents._view import Facts
from asia.agents.library.family import Family
from asia.agents.library.recipe import Recipe
from asia.agents.library.space import Choice, Space, Span

LM = "LevenbergMarquardt"
STRUCTURES = ("hammerstein", "wiener", "hammerstein_wiener", "wiener_hammerstein")


def _linear(_: Facts) -> Recipe:
    return Recipe("linear", (("order", None), ("delay", None)), LM, (("iterations", 30),))


def _linear_space(_: Facts) -> Space:
    return Space(
        config=(Choice("order", (None, 1, 2, 3, 4, 5, 6)), Choice("delay", (0, None))),
        options=(Choice("iterations", (15, 30, 60)),),
    )


def _neural_ss(_: Facts) -> Recipe:
    config = (("nonlinearity", "state"), ("hidden", 8), ("ridge", 1e-5), ("delay", None))
    return Recipe("neural_ss", config, LM, (("iterations", 60), ("starts", 2)))


def _neural_ss_space(_: Facts) -> Space:
    return Space(
        config=(
            Choice("order", (None, 2, 3, 4)),
            Choice("nonlinearity", ("state", "input", "output", "both")),
            Choice("channels", (None, 1, 2), needs="nonlinearity", being="state"),
            Choice("hidden", (4, 8, 12)),
            Span("ridge", 1e-6, 1e-2),
            Choice("delay", (0, None)),
            Choice("members", (1, 3)),
        ),
        options=(Choice("iterations", (40, 80)), Choice("starts", (1, 2, 4))),
    )


def _blocks(_: Facts) -> Recipe:
    config = (("structure", "wiener_hammerstein"), ("hidden", 8), ("ridge", 1e-5), ("delay", None))
    return Recipe("block_oriented", config, LM, (("iterations", 60), ("starts", 2)))


def _blocks_space(_: Facts) -> Space:
    return Space(
        config=(
            Choice("structure", STRUCTURES),
            Choice("order", (None, 2, 3, 4)),
            Choice("hidden", (4, 8, 12)),
            Span("ridge", 1e-6, 1e-2),
            Choice("delay", (0, None)),
        ),
        options=(Choice("iterations", (40, 80)), Choice("starts", (1, 2, 4))),
    )


def _arx(_: Facts) -> Recipe:
    config = (("structure", "oe"), ("delay", None))
    return Recipe("arx", config, LM, (("iterations", 30),))


def _arx_space(_: Facts) -> Space:
    return Space(
        config=(
            Choice("na", (None, 1, 2, 3, 4)),
            Choice("nb", (None, 1, 2, 3, 4)),
            Choice("delay", (0, None)),
            Choice("structure", ("arx", "oe")),
        ),
        options=(Choice("iterations", (15, 30, 60)),),
    )


def _narx(_: Facts) -> Recipe:
    config = (("degree", 2), ("delay", 0), ("margin", 0.1), ("coefficient_ridge", 1e-5))
    return Recipe("narx", config, LM, (("iterations", 40),))


def _narx_space(_: Facts) -> Space:
    return Space(
        config=(
            Choice("na", (None, 1, 2, 3)),
            Choice("nb", (None, 1, 2, 3)),
            Choice("delay", (0, None)),
            Choice("degree", (2, 3)),
            Choice("terms", (None, 8, 15, 25)),
            Choice("margin", (0.0, 0.05, 0.1, 0.3)),
            Span("coefficient_ridge", 1e-7, 1e-2),
        ),
        options=(Choice("iterations", (15, 30, 60)),),
    )


def _gp_narx(_: Facts) -> Recipe:
    config = (("mean", "linear"), ("points", 800), ("delay", 0), ("margin", 0.1))
    return Recipe("gp_narx", config, "MarginalLikelihood", (("iterations", 60),))


def _gp_narx_space(_: Facts) -> Space:
    return Space(
        config=(
            Choice("na", (None, 1, 2, 3)),
            Choice("nb", (None, 1, 2, 3)),
            Choice("delay", (0, None)),
            Choice("mean", ("linear", "hold")),
            Choice("points", (400, 800)),
            Choice("margin", (0.0, 0.1, 0.3)),
        ),
        options=(Choice("iterations", (30, 60)),),
    )


def _esn(_: Facts) -> Recipe:
    config = (("units", 300), ("radius", 0.9), ("input_scale", 0.5), ("longest", 50.0))
    return Recipe("esn", config, "LeastSquares", (("ridge", None),))


def _esn_space(_: Facts) -> Space:
    return Space(
        config=(
            Choice("units", (100, 300, 600, 1200)),
            Span("radius", 0.5, 1.2),
            Span("input_scale", 0.05, 2.0),
            Span("longest", 10.0, 300.0),
        ),
        options=(),
    )


CLASSICAL: tuple[Family, ...] = (
    Family(
        name="linear",
        label="linear state-space",
        use="how far a linear model goes, and the start of the nonlinear ones",
        base=7,
        points=(("windows", -3),),
        trial=_linear,
        full=_linear,
        space=_linear_space,
    ),
    Family(
        name="neural_ss",
        label="neural state-space",
        use="a linear model with small static nonlinearities, for short records",
        base=6,
        points=(("short", 1), ("long", -2), ("windows", -2)),
        trial=_neural_ss,
        full=_neural_ss,
        space=_neural_ss_space,
    ),
    Family(
        name="block_oriented",
        label="block-oriented model",
        use="linear systems in series with static functions: actuators and sensors that bend",
        base=5,
        points=(("long", -1), ("windows", -3), ("several", -1)),
        trial=_blocks,
        full=_blocks,
        space=_blocks_space,
    ),
    Family(
        name="narx",
        label="polynomial NARX",
        use="a few products of lagged signals, readable: smooth nonlinearities, low noise",
        base=4,
        points=(("short", 0.5), ("windows", -3), ("several", -1)),
        trial=_narx,
        full=_narx,
        space=_narx_space,
    ),
    Family(
        name="gp_narx",
        label="Gaussian-process NARX",
        use="any smooth nonlinearity from few samples",
        base=3,
        points=(("short", 1), ("windows", -2), ("several", -1)),
        unfit=frozenset({"long"}),
        trial=_gp_narx,
        full=_gp_narx,
        space=_gp_narx_space,
    ),
    Family(
        name="esn",
        label="echo state network",
        use="a random reservoir with a linear readout, fitted in seconds",
        base=2.5,
        points=(("long", 1),),
        trial=_esn,
        full=_esn,
        space=_esn_space,
    ),
    Family(
        name="arx",
        label="output-error model",
        use="a linear difference equation, where its coefficients are wanted",
        base=2,
        points=(("windows", -1),),
        trial=_arx,
        full=_arx,
        space=_arx_space,
    ),
)
