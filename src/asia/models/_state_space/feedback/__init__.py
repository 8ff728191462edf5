"""Linear systems with static functions in feedback: what the functions read, starts, fits."""
