"""What was computed about the winner: its parameters, its bands, and whether it was luck."""

from asia.report._page.sections.evidence import ablation, bands, confirmation, identified

__all__ = ["ablation", "bands", "confirmation", "identified"]
