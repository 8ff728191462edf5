"""Models that predict one step ahead and are used in free run."""
