"""The fit of a fold as a message: bytes go to a worker machine, and bytes come back."""
