"""Candidate contract: what a `candidate.py` receives and returns, and the static checks of its
source.
"""

from __future__ import annotations

import ast
from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field, fields
from functools import cache, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np

import asia
from asia._plugins import is_installed
from asia._source import Imports, SourceFacts, imports_of
from asia._syntax import syntax_tree
from asia.data.frequency import FrequencyRecord
from asia.data.trajectory import Array, Signal, Trajectory
from asia.errors import CandidateError, Reason
from asia.problem.physics import Physics
from asia.problem.plant import Plant
from asia.problem.symmetry import Symmetry

if TYPE_CHECKING:
    from asia.problem.control_task import ControlTask
    from asia.problem.feedback import Loop

# Contract of a candidate: the context of a fit and the interface of a fitted model.


VALIDATION_SCORES = 200


def _no_log(step: float, loss: float) -> None:
    del step, loss


@dataclass(frozen=True)
class KnownSystem:
    """The system and its protocol, as candidates and agents know them."""

    inputs: tuple[Signal, ...]
    """Names and units of the inputs."""
    outputs: tuple[Signal, ...]
    """Names and units of the outputs."""
    sampling_time: float
    """Seconds."""
    n_past_u: int
    """Samples of the inputs in the past window."""
    n_past_y: int
    """Samples of the outputs in the past window."""
    horizon: int | None = None
    """Samples to simulate; None for the whole trajectory."""
    metric: str = "rmse"
    """Name of the metric that V is computed with."""
    physics: Physics | None = None
    """Equations from the problem file."""
    _: KW_ONLY
    symmetry: Symmetry = field(default_factory=dict[str, Mapping[str, str]])
    """Changes of the signals that leave the system's laws as they are, by name: for each signal
    that changes, the one that takes its place, with a minus where its sign changes."""
    loop: Loop | None = None
    """Feedback loop of the records, whose `reference` it names; None for open loop."""
    plant: Plant | None = None
    """Simulator of the user's own, from the problem file."""
    control: ControlTask | None = None
    """Task of a controller; None where a model is fitted."""
    responses: tuple[FrequencyRecord, ...] = ()
    """Measured frequency responses, with the channels of the problem."""

    @property
    def nu(self) -> int:
        """Number of inputs."""
        return len(self.inputs)

    @property
    def ny(self) -> int:
        """Number of outputs."""
        return len(self.outputs)

    def known(self) -> dict[str, Any]:
        """Return the fields of this class by name, for another view of the same system."""
        return {one.name: getattr(self, one.name) for one in fields(KnownSystem)}


@dataclass(frozen=True, kw_only=True)
class Context(KnownSystem):
    """Everything that a candidate knows apart from its training trajectories. In a control problem
    inputs, outputs and equations are those of the plant to be controlled."""

    seed: int = 0
    """Seed for one search, fold and repeat, the same for every candidate."""
    deadline: float = float("inf")
    """Value of `time.monotonic()` after which the worker is killed."""
    threads: int = 1
    """Threads that a fit may use."""
    log: Callable[[float, float], None] = field(default=_no_log, compare=False)
    """log(step, loss): two numbers for the training curve."""
    validation_score: Callable[[Model], float] | None = field(default=None, compare=False)
    """validation_score(model): the fold's normalised metric of `model` on the held-out part, inf
    for a simulation that is not finite. There are VALIDATION_SCORES calls a fit, then it raises
    RuntimeError; its time counts as fit time. None unless the protocol's early_stopping is
    "validation", and None then too where nothing is held out: in the refit on all data."""
    fold_models: Callable[[], Sequence[Model]] = field(default=tuple[()], compare=False)
    """fold_models(): models of the folds, which a refit on all data may start from; () in the fits
    of the folds and where a refit starts anew."""
    detrend: bool = False
    """Whether the mean over the training records of this fit was subtracted from every signal. The
    model receives signals of this kind and gives such outputs."""
    scale: bool = False
    """Whether every signal was divided by its standard deviation over the training records of this
    fit; the units are then `std`."""


class Model(Protocol):
    """A fitted model.

    It may also have `parameters() -> Mapping[str, float]`, by which the folds are compared: names
    of up to 48 characters and at most 64 finite numbers. It is asked for once, after the fit. And
    it may be a `StepModel` as well: then it is scored by its steps, one input sample at a time, and
    `asia export` prints it for other programs.
    """

    def simulate(self, past_u: Array, past_y: Array, u: Array) -> Array:
        """Simulate in open loop, in physical units.

        `u[:, k]` and `y_hat[:, k]` are the same sample; `past_*[:, -1]` is the one before. B and H
        are 1 or more, whatever the context's horizon. The result for a row depends on that row
        only, y_hat[:, k] on no later input, and neither on earlier calls.

        Args:
            past_u: past inputs (B, n_past_u, nu).
            past_y: past outputs (B, n_past_y, ny).
            u: inputs (B, H, nu).

        Returns:
            Simulated outputs y_hat (B, H, ny).
        """
        ...


Fit = Callable[[Sequence[Trajectory], Context], Model]


class Controller(Protocol):
    """A controller, made by `design(models, context)` of a candidate for a control problem.

    `models` are identified models of the plant (`StepModel`): of all open-loop records, then of
    parts of them. It may keep a state: every scenario begins with a copy of what `design` returned.
    """

    def step(self, r: Array, y: Array) -> Any:
        """Inputs u (nu,) for the next sample, in physical units.

        Limits of value and rate apply to them whatever comes.

        Args:
            r: set points (nr,) of this sample
            y: measured outputs (ny,) at its beginning
        """
        ...


# Estimates of a fitted model's parameters: standard errors, intervals and correlations.


@dataclass(frozen=True)
class ParameterEstimate:
    """A parameter with its uncertainty."""

    name: str
    """Name as in `parameters()`; at most 48 characters are kept."""
    value: float
    """Estimate in the parameter's unit."""
    standard_error: float
    """Standard error in the same unit; infinite where the records carry no information on it."""
    low: float
    """Lower end of the 95 % interval."""
    high: float
    """Upper end of the 95 % interval."""
    unit: str = ""
    """Unit of the parameter; at most 16 characters are kept."""
    lower: float = float("-inf")
    """Least value that the fit searched; -inf for an open range."""
    upper: float = float("inf")
    """Greatest value that the fit searched; inf for an open range."""
    data_share: float = 1.0
    """Share of the information on the parameter that comes from the records, from 0 to 1; the rest
    comes from a prior or a ridge."""
    misfit_error: float = 0.0
    """Possible shift by a missing effect: half the width of an interval around the value; 0 where
    the residuals show no missing effect."""


@dataclass(frozen=True)
class ParameterEstimates:
    """Estimates of all parameters of a model, with their correlations."""

    parameters: tuple[ParameterEstimate, ...]
    """Estimates, one a parameter; at most 64 are kept."""
    correlation: Array
    """Correlations (n, n) of the errors; nan where one is not known."""
    equations: tuple[str, ...] = ()
    """The model's equations with the numbers put in, one a line; 8000 characters are kept."""
    reason: str = ""
    """Why there are values alone, without standard errors; "" where there are."""


# Libraries that a candidate will import, read from its source and from the model library.


JAX = frozenset({"jax"})
_LOAD_JAX = ("jax", "equinox", "optax")


@lru_cache(64)
def imported_libraries(source: str, *, fitting: bool) -> frozenset[str]:
    """Return `JAX` if executing a source loads it, else nothing: no other library takes long to
    load.

    Args:
        source: Python source of a candidate.
        fitting: include what modules of `asia.models` import when they are called; at their top
            those modules import what they cannot do without.
    """
    found = _reached(_imports(source), fitting=fitting)
    return JAX if any(name.split(".")[0] in _LOAD_JAX for name in found) else frozenset()


def _reached(own: Imports, *, fitting: bool) -> set[str]:
    """Modules that a source imports directly or through the library."""
    found, queue, seen = set(own.first), [*own.first], set[str]()
    while queue:
        name = queue.pop()
        if name in seen or not f"{name}.".startswith("asia.models."):
            continue
        seen.add(name)
        inside = _imports_of_module(name)
        found |= inside.first
        queue += [*inside.first, *(inside.later if fitting else ())]
    return found


@cache
def _imports_of_module(name: str) -> Imports:
    """Imports of a module of this package; none if there is no such module."""
    place = Path(asia.__file__).parent.joinpath(*name.split(".")[1:])
    for path in (place.with_suffix(".py"), place / "__init__.py"):
        if path.is_file():
            return imports_of(syntax_tree(path.read_text("utf-8"), path.name))
    return Imports()


def _imports(source: str) -> Imports:
    """Imports of a candidate; none where its source cannot be read."""
    try:
        return _facts(source).imports
    except CandidateError:
        return Imports()


# Libraries that a candidate may import beside the standard one and `asia.models`.


def installed_libraries() -> tuple[str, ...]:
    """Names of these libraries that are installed here, as agents and users read them."""
    libraries = ("numpy", "scipy", "jax", "equinox", "optax")
    return tuple(name for name in libraries if is_installed(name))


# Check and identify the source of a candidate before anything of it runs.


def _facts(source: str) -> SourceFacts:
    # Not at the top: a worker imports this module and reads no source.
    from asia._source_reader import read_source

    return read_source(source)


def library_only(source: str) -> bool:
    """Return whether a source does nothing but call families and methods of the library with
    constants, so that its worker runs no code but that of ASIA.

    Raises:
        CandidateError: as for `check_source`, if the source does not parse.
    """
    return _facts(source).library_only


def check_source(source: str) -> None:
    """Refuse a source that cannot be a candidate, without executing it.

    Raises:
        CandidateError: SYNTAX if it does not parse, or takes too long or too much memory to parse,
            CONTRACT if it defines no top-level name `fit` or `design`, SOURCE_SIZE if it is over
            64 KB.
    """
    facts = _facts(source)
    if not facts.defines_fit:
        raise CandidateError(
            Reason.CONTRACT,
            "the source defines no top-level function fit(trajectories, context), nor, for a "
            "controller, design(models, context)",
        )
    executed_source(source)


def executed_source(source: str) -> str:
    """Source that a worker executes: without comments and docstrings, which could carry data.

    Lines keep their numbers.

    Raises:
        CandidateError: SYNTAX if the source does not parse, or if its layout does not permit
            telling comments from code.
    """
    bare = _facts(source).bare
    if bare is None:
        raise CandidateError(
            Reason.SYNTAX,
            "comments cannot be separated from code: use plain line ends and indents",
        )
    return bare


def source_digest(source: str) -> str:
    """Digest of the normalised syntax tree: comments, docstrings and layout do not count.

    Returns:
        sha256 in hex.

    Raises:
        CandidateError: as for `check_source`, if the source does not parse.
    """
    return _facts(source).digest


def source_tree(source: str) -> ast.Module:
    """Syntax tree of a source that a process with limits has read before, so that parsing it once
    more in this process is cheap.

    Raises:
        CandidateError: as for `source_digest`.
    """
    _facts(source)
    return syntax_tree(source, "candidate.py")


# State-space step contract of a fitted model, used for simulation and for `asia export`.


@runtime_checkable
class StepModel(Protocol):
    """Fitted model that simulates sample by sample, in physical units, for a batch of B cases.

    Both methods compute with NumPy arrays, and with JAX arrays where they are traced (`asia
    export`): they choose nothing by the values of signals. A state is any tree (tuples, lists,
    dicts) of arrays (B, ...) whose shapes stay the same; constants of float64 keep their precision.
    The result for a row depends on that row only.
    """

    def initial(self, past_u: Any, past_y: Any, u: Any) -> Any:
        """State at the first sample, continued into the past by models that need it.

        Args:
            past_u: past inputs (B, n_past_u, nu).
            past_y: past outputs (B, n_past_y, ny).
            u: input (B, nu) of the first sample.
        """
        ...

    def step(self, state: Any, u: Any) -> tuple[Any, Any]:
        """Advance the state by one sample.

        Args:
            state: state at this sample.
            u: input (B, nu) of this sample.

        Returns:
            State at the next sample, and the output (B, ny) of this one.
        """
        ...


def simulate_steps(model: StepModel, past_u: Array, past_y: Array, u: Array) -> Array:
    """Simulate step by step: the `simulate` of a model that has no faster one.

    Args:
        model: fitted model.
        past_u: past inputs (B, n_past_u, nu).
        past_y: past outputs (B, n_past_y, ny).
        u: inputs (B, H, nu), H at least 1.

    Returns:
        Outputs (B, H, ny).
    """
    state, outputs = model.initial(past_u, past_y, u[:, 0]), list[Array]()
    for k in range(u.shape[1]):
        state, y = model.step(state, u[:, k])
        outputs.append(y)
    return np.stack(outputs, axis=1)
