"""Cards, one file a kind of family: its rows with the size for tests, and its moves.

A file here is found by itself; it holds a `CARD`.
"""
