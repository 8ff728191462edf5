"""Assurance: benchmark comparisons."""
