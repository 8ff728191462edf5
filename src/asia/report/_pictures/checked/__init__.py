"""Pictures of `asia check`."""
