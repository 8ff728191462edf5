"""Levenberg-Marquardt, and least squares."""
