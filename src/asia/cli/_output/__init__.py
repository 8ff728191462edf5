"""Text output of the commands: numbers, one experiment, a running search."""
