"""Append-only, hash-chained record of a search; all else is a view of it."""
