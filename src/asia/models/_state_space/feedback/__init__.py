"""Linear systems with static functions in feedback: regressors of the functions, starts, fits."""
