"""Errors, grouped by the side that can correct them."""

import builtins
from enum import StrEnum
from typing import Literal

KNOWN_ERRORS = frozenset(
    name
    for name, value in vars(builtins).items()
    if isinstance(value, type) and issubclass(value, BaseException)
) | {"LinAlgError", "JaxRuntimeError", "XlaRuntimeError", "EquinoxRuntimeError", "UnpicklingError"}
"""Names of exceptions that a candidate did not define, so that they carry no words of its own."""


class Reason(StrEnum):
    """Reason for a missing score; `advice` describes the remedy."""

    SYNTAX = "syntax"
    CONTRACT = "contract"
    CRASH = "crash"
    EXITED = "exited"
    FIT_TIMEOUT = "fit_timeout"
    SIMULATE_TIMEOUT = "simulate_timeout"
    MEMORY = "memory"
    THREADS = "threads"
    NOT_FINITE = "not_finite"
    WRONG_LENGTH = "wrong_length"
    UNSOLICITED = "unsolicited"
    MODEL_SIZE = "model_size"
    NOT_REPRODUCIBLE = "not_reproducible"
    SOURCE_SIZE = "source_size"
    SUSPECT = "suspect"
    RESTART = "restart"

    @property
    def status(self) -> Literal["crash", "timeout", "invalid"]:
        """`crash`, `timeout` or `invalid`: the word for the ledger."""
        if self in (Reason.FIT_TIMEOUT, Reason.SIMULATE_TIMEOUT):
            return "timeout"
        if self in (Reason.CRASH, Reason.EXITED, Reason.MEMORY, Reason.THREADS):
            return "crash"
        return "invalid"

    @property
    def advice(self) -> str:
        """Failure and remedy in one sentence."""
        return _ADVICE[self]


_ADVICE = {
    Reason.SYNTAX: "the source does not parse: correct the line named below",
    Reason.CONTRACT: "the candidate breaks the contract: "
    "define fit(trajectories, context) that returns a model with simulate(past_u, past_y, u), or "
    "for a control problem design(models, context) that returns a controller with step(r, y)",
    Reason.CRASH: "the candidate raised an exception: correct the error at the line named below",
    Reason.EXITED: "the worker process ended before it answered: "
    "do not call exit, and look for a crash in compiled code",
    Reason.FIT_TIMEOUT: "fit exceeded its time: "
    "lower the model size or the iterations, or raise budget.fit_seconds",
    Reason.SIMULATE_TIMEOUT: "simulate exceeded its time: "
    "compile the loop over time, or raise budget.fit_seconds",
    Reason.MEMORY: "the worker ran out of memory: "
    "lower the model or batch size, or raise budget.memory_mb",
    Reason.THREADS: "the worker runs too many threads or processes: start fewer",
    Reason.NOT_FINITE: "the simulation diverged to NaN or infinity: "
    "constrain stability, bound the states or lower the learning rate",
    Reason.WRONG_LENGTH: "the reply has the wrong size: "
    "simulate must return an array (B, H, ny), one row for each input row",
    Reason.UNSOLICITED: "the worker sent bytes without a request: do not write to the result pipe",
    Reason.MODEL_SIZE: "the fitted model is too large to keep: lower the number of parameters",
    Reason.NOT_REPRODUCIBLE: "the model reloaded in a fresh process simulates differently: "
    "keep everything simulate needs inside the model",
    Reason.SOURCE_SIZE: "the source is too long: "
    "let fit estimate numbers from the training records, and shorten the rest",
    Reason.SUSPECT: "the simulation does not behave like a dynamical system: "
    "make simulate a causal, continuous function of each row alone, with no memory between calls",
    Reason.RESTART: "the model is accurate from the scored initial samples only: "
    "make simulate equally accurate from any other sample of a record",
}


class AsiaError(Exception):
    """Root of all errors raised on purpose."""


class UserError(AsiaError):
    """Error that the user can correct; the command line prints only its text and exits with 2."""


class CandidateError(AsiaError):
    """The candidate's own failure; becomes a `Failure` in the ledger."""

    def __init__(self, reason: Reason, detail: str = "", printed: str = "") -> None:
        """printed: text that the candidate printed before."""
        super().__init__(f"{reason.value}: {detail}" if detail else reason.value)
        self.reason = reason
        self.detail = detail
        self.printed = printed


class SandboxError(AsiaError):
    """Failure of the sandbox itself, not of the candidate."""


class InternalError(AsiaError):
    """Bug in ASIA."""
