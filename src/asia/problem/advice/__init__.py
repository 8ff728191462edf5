"""Advice of `asia check` about the data, next to their figures."""
