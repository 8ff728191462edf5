"""Contract of a candidate: the arguments that `candidate.py` receives and the model that it
returns."""

from asia.candidate._contract import VALIDATION_SCORES, Context, Fit, Model
from asia.candidate._estimates import ParameterEstimate, ParameterEstimates
from asia.candidate._imports import imported_libraries, trains_network
from asia.candidate._libraries import installed_libraries
from asia.candidate._source import check_source, executed_source, source_digest
from asia.candidate._steps import StepModel, simulate_steps

__all__ = [
    "VALIDATION_SCORES",
    "Context",
    "Fit",
    "Model",
    "ParameterEstimate",
    "ParameterEstimates",
    "StepModel",
    "check_source",
    "executed_source",
    "imported_libraries",
    "installed_libraries",
    "simulate_steps",
    "source_digest",
    "trains_network",
]
