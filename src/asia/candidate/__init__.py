"""The candidate contract: what a `candidate.py` is given and what it gives back."""

from asia.candidate._contract import Context, Fit, Model

__all__ = ["Context", "Fit", "Model"]
