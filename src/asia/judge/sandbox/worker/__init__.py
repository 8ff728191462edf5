"""A worker process, from both ends."""
