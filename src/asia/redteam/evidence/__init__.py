"""What an attack leaves, and what that amounts to."""
