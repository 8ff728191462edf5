"""Parts of the controllers."""
