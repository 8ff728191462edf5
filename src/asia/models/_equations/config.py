"""Grey-box settings: what is added to the equations, and the coordinates that training searches."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Literal, get_args

from asia.data.trajectory import Intersample
from asia.models._equations.additions import NO_NUMBERS, NO_PRIORS, LearnedNumbers, ParameterPriors
from asia.models._equations.ode import Equations
from asia.models._numerics.intersample import Between
from asia.problem.physics import Name, ParameterRange

Initial = Literal["measured", "estimated"]
Sensor = Literal["power", "spline"]


@dataclass(frozen=True)
class Config:
    """Grey-box: the problem's equations and what is added to them.

    Every addition has no effect at its prior mean. A ridge holds it there: `residual_ridge` the
    network; `ridge` linear term, offsets and delay; limits and spilled fractions, being physical,
    are held as weakly as the parameters of the equations.
    """

    physics: tuple[str, ...] = ()
    """`[physics]` as text, in place of the problem's. Of several a search chooses."""
    saturation: tuple[str, ...] = ()
    """States with a learned upper limit, such as the level of a tank that can be full."""
    spill: bool = False
    """Let a learned fraction of what a full state cannot hold go into the next state."""
    linear: bool = False
    """Add a linear term in states and inputs to the dynamics."""
    offset: tuple[str, ...] = ()
    """Outputs that get a constant bias, and states whose derivative gets one."""
    input_delay: float = 0.0
    """Greatest input delay searched, in samples; 0 is none."""
    residual: int = 0
    """Hidden tanh units of a network of states and inputs added to the dynamics; 0 is none."""
    ridge: float = 1e-3
    """Weight of the sum of squared effects beside the mean squared normalised simulation error; an
    effect of 1 is as large as the signal it acts on."""
    residual_ridge: float = 1e-2
    """Weight of the sum of squared effects of the network."""
    robust: float | None = None
    """Huber threshold in standard deviations of the output; None is least squares."""
    substeps: int = 2
    """Runge-Kutta steps of order 4 from one sample to the next."""
    intersample: Intersample | None = None
    """Inputs between samples where problem file and records leave them open: "zero" (held), "first"
    (linear) or "band_limited" (a curve). None lets a search choose, and else holds them."""
    initial: Initial | None = None
    """Initial state of a simulation: "measured" takes the last measured outputs, where every state
    is an output; "estimated" uses the whole past window. None is measured with a horizon, where
    that is possible, and else estimated. No option sets it and a trained model keeps none: each
    call of `simulate` finds it anew from the past window that it is given; "measured" takes
    `past_y[:, -1]`."""
    sensor: Sensor | None = None
    """Rising curve from the equations' output to the measured one: "power" has a learned zero and
    exponent, "spline" a learned zero and slopes; None is none. It goes from the lowest to the
    highest value of the state that is observed (else of the data)."""
    lag: tuple[str, ...] = ()
    """States and inputs that act on other states through a first-order lag that is learned."""
    smooth: tuple[str, ...] = ()
    """States and inputs that enter the equations times exp(g), g a smooth function of them with a
    Gaussian-process prior."""
    smooth_width: float = 0.05
    """Prior standard deviation of g."""
    prior_width: float | None = 1.0
    """Factor on the standard deviations of priors on parameters; None ignores them."""
    priors: tuple[tuple[str, float, float, str], ...] = ()
    """Further priors: (expression in parameters, mean, standard deviation, reason). What options
    add, such as limits, spilled fractions, lags and sensors, has a prior of its own around no
    effect, which no option changes; `ridge` weighs it for the linear term, offsets and delays."""
    friction: tuple[str, ...] = ()
    """Velocities among the states that get dry friction. It is smooth Coulomb and Stribeck friction
    with viscous friction, each with separate levels in the two directions."""
    presliding: bool = False
    """Let dry friction give way before it slides (LuGre, which has a state)."""
    hysteresis: tuple[str, ...] = ()
    """Velocities among the states that get a Bouc-Wen force, which has a state."""
    play: tuple[str, ...] = ()
    """States and inputs that act on other states behind a play (backlash). Its width is learned."""
    discover: tuple[str, ...] = ()
    """States whose derivatives get missing terms. They are numbers times products of signals, found
    sequentially by how much of the simulation error they explain."""
    most_terms: int = 3
    """Greatest number of such terms."""

    def __post_init__(self) -> None:
        if self.spill and not self.saturation:
            raise ValueError("greybox.Config: spill needs a state in saturation")
        if self.residual < 0 or self.input_delay < 0:
            raise ValueError("greybox.Config: residual and input_delay must be >= 0")
        if self.ridge < 0 or self.residual_ridge < 0:
            raise ValueError("greybox.Config: ridge and residual_ridge must be >= 0")
        if self.substeps < 1:
            raise ValueError("greybox.Config: substeps must be >= 1")
        if self.sensor not in (None, *get_args(Sensor)):
            raise ValueError('greybox.Config: sensor must be None, "power" or "spline"')
        if self.intersample not in (None, *get_args(Intersample)):
            raise ValueError(
                'greybox.Config: intersample must be None, "zero", "first" or "band_limited"'
            )
        if self.smooth_width <= 0 or (self.prior_width is not None and self.prior_width <= 0):
            raise ValueError("greybox.Config: smooth_width and prior_width must be > 0")
        for expression, _, deviation, _ in self.priors:
            if deviation <= 0:
                raise ValueError(
                    f"greybox.Config: the prior on '{expression}' needs a standard deviation > 0"
                )
        if self.presliding and not self.friction:
            raise ValueError("greybox.Config: presliding needs a velocity in friction")
        if self.most_terms < 1:
            raise ValueError("greybox.Config: most_terms must be >= 1")
        if self.discover and self.residual:
            raise ValueError("greybox.Config: give discover or residual, not both")
        if set(self.lag) & set(self.play):
            raise ValueError("greybox.Config: a signal has a lag or a play, not both")
        if self.robust is not None and self.robust <= 0:
            raise ValueError("greybox.Config: robust must be > 0 or None")

    @property
    def augmented(self) -> bool:
        """Something is added to the equations."""
        return bool(
            self.saturation
            or self.linear
            or self.offset
            or self.input_delay
            or self.residual
            or self.extends
        )

    @property
    def extends(self) -> bool:
        """Something is written into the equations."""
        written = self.sensor or self.lag or self.smooth
        return bool(written or self.friction or self.hysteresis or self.play)

    @property
    def drawn(self) -> bool:
        """Starting points of learned numbers are drawn: forces that switch have poor minima near
        zero."""
        return bool(self.friction or self.hysteresis or self.play)

    @property
    def hides(self) -> bool:
        """The config adds states that no measurement shows."""
        return bool((self.friction and self.presliding) or self.hysteresis or self.play)


@dataclass(frozen=True)
class GreyBoxStructure:
    """Structure of a grey-box, fixed before training. Hashable: it is a key of compiled
    programs."""

    equations: Equations  # Equations from the problem file, with the additions written in
    config: Config  # Additions to the equations
    ranges: tuple[ParameterRange, ...]  # Search ranges of the parameters, in their order
    low: tuple[float, ...]  # Lower physical bounds of the states (nx,), infinite where open
    high: tuple[float, ...]  # Upper physical bounds of the states (nx,), infinite where open
    sampling_time: float  # Sampling time in s
    n_past_u: int  # Number of inputs in a past window
    n_past_y: int  # Number of outputs in a past window
    states_measured: bool = False  # Simulations start at the last measured outputs
    learned: LearnedNumbers = NO_NUMBERS
    """Numbers of the additions that are written into the equations."""
    problem_states: int | None = None
    """Number of states of the problem file's equations, which come first; None is all."""
    priors: ParameterPriors = NO_PRIORS  # Prior knowledge of the parameters
    time_step: int | None = None
    """Input that holds the time to the next sample; None for one sampling time."""
    memory: tuple[int, ...] = ()
    """Samples in the buffer of each delay of the equations; () before the records are known."""
    shown: tuple[tuple[int, int], ...] | None = None
    """`measured_states` where the observation has been changed."""
    intersample: Between | None = None
    """Inputs between samples; None holds all."""

    def __post_init__(self) -> None:
        states, outputs = self.equations.states, self.equations.outputs
        signals = states + self.equations.inputs
        for field, names, known in (
            ("saturation", self.config.saturation, states),
            ("offset", self.config.offset, states + outputs),
            ("lag", self.config.lag, signals),
            ("smooth", self.config.smooth, signals),
            ("friction", self.config.friction, states),
            ("hysteresis", self.config.hysteresis, states),
            ("play", self.config.play, signals),
            ("discover", self.config.discover, states),
        ):
            for name in names:
                if name not in known:
                    raise ValueError(
                        f"greybox.Config: {field} names '{name}', known are {', '.join(known)}"
                    )

    @property
    def nx(self) -> int:
        """Number of states."""
        return len(self.equations.states)

    @property
    def nx_own(self) -> int:
        """Number of states of the problem file's equations."""
        return self.nx if self.problem_states is None else self.problem_states

    @property
    def nu(self) -> int:
        """Number of inputs."""
        return len(self.equations.inputs)

    @property
    def ny(self) -> int:
        """Number of outputs."""
        return len(self.equations.outputs)

    @property
    def n_past(self) -> int:
        """Number of samples before the first simulated one."""
        return max(self.n_past_u, self.n_past_y)

    @property
    def n_fit(self) -> int:
        """Number of samples before the first simulated one over which the state is fitted: those
        whose inputs are known, and without past inputs, or when it is measured, the newest output.
        Where inputs move between samples the first one ends an interval.
        """
        if self.states_measured:
            return 1
        return max(self.n_past_u, min(self.n_past_y, 1), min(self.between.memory, 1))

    @cached_property
    def between(self) -> Between:
        """Inputs between samples."""
        return self.intersample or Between(("zero",) * self.nu)

    @cached_property
    def measured_states(self) -> dict[int, int]:
        """Output index of each state that is observed as it is."""
        if self.shown is not None:
            return dict(self.shown)
        system = self.equations
        pairs = [
            (system.states.index(expression.root.name), k)
            for k, expression in enumerate(system.observation)
            if isinstance(expression.root, Name) and expression.root.name in system.states
        ]
        return dict(pairs)

    @cached_property
    def layout(self) -> Layout:
        """Layout of the vector of coordinates."""
        return Layout.of(self)


@dataclass(frozen=True)
class Layout:
    """Slices of the coordinate vector, one for each part of the model."""

    parameters: slice  # Parameters of the equations
    limits: slice  # Limits, one for each saturated state
    spill: slice  # Fractions that full states hand on
    linear: slice  # Matrix (nx, nx + nu)
    rate_offset: slice  # Offsets of derivatives
    output_offset: slice  # Offsets of outputs that are no states
    delay: slice  # Delays, one for each input
    hidden: slice  # First layer (units, nx + nu + 1) of the residual network
    readout: slice  # Output layer (nx, units) of the residual network
    size: int  # Length of the vector
    learned_from: int = 0
    """First of the numbers that are written into the equations, which come last."""

    @property
    def learned(self) -> slice:
        """Numbers that are written into the equations."""
        return slice(self.learned_from, self.size)

    @classmethod
    def of(cls, structure: GreyBoxStructure) -> Layout:
        """Layout of `structure`."""
        config, nx, nu = structure.config, structure.nx_own, structure.nu
        observed = structure.equations.outputs
        sizes = (
            len(structure.ranges),
            len(config.saturation),
            len(config.saturation) if config.spill else 0,
            nx * (nx + nu) if config.linear else 0,
            sum(name in structure.equations.states for name in config.offset),
            sum(
                name in observed and name not in structure.equations.states
                for name in config.offset
            ),
            nu if config.input_delay else 0,
            config.residual * (nx + nu + 1),
            config.residual * nx,
            len(structure.learned.names),
        )
        edges = [0]
        for size in sizes:
            edges.append(edges[-1] + size)
        slices = [slice(a, b) for a, b in pairwise(edges)]
        return cls(*slices[:-1], size=edges[-1], learned_from=edges[-2])
