"""Assurance: red team and benchmark comparisons."""
