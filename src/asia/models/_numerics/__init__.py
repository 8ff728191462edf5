"""Training records as arrays: scaling, windows, segments, lags."""
