"""Sandboxed worker processes for untrusted candidates; their replies are bytes that are never
parsed."""
