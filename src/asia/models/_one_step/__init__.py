"""Models that predict one step ahead, used in free run."""
