"""Report page of a run: one HTML file with everything, offline."""
