"""Noise models of residuals."""
