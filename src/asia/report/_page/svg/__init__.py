"""Drawings of the page: small SVG in its colours, the same bytes for the same numbers."""
