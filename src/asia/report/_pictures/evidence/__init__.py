"""Pictures of what is computed about a finished model."""
