"""Evidence on the winner: its parameters, its bands, its confirmation and its ablation."""

from asia.report._page.sections.evidence import ablation, bands, confirmation, identified

__all__ = ["ablation", "bands", "confirmation", "identified"]
