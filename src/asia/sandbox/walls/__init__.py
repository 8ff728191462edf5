"""What the levels are built of."""
