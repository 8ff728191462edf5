"""What `asia check` draws."""
