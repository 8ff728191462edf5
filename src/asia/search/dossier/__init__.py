"""The validation dossier of a run: what the checks look at is made in the sandbox."""

from asia.search.dossier.validate import Dossier, validate

__all__ = ["Dossier", "validate"]
