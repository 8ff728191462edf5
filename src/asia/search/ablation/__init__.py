"""Ablation of the winner: fits with parts of its changes reverted."""
