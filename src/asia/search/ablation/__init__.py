"""What the gain of a search is due to: fits of its winner with parts taken back."""
