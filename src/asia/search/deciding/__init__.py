"""The decision on a candidate, and on the end of a search."""
