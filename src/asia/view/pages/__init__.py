"""Pages of the live view: HTML from snapshots of runs."""
