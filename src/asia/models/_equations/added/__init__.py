"""What is written into the equations, and what is known of their parameters."""
