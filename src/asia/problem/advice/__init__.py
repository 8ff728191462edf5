"""What `asia check` says of the data beside their figures."""
