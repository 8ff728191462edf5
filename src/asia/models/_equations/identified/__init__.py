"""What a trained grey-box says of itself: its parameters with their uncertainty, its equations."""
