"""Figures, tables and methods paragraph of a run for a paper."""
