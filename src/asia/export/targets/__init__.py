"""One printer a target."""
