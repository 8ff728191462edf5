"""Fitted models as small programs of a closed set of operations, the source of every export.

model = lowered(step_model, n_past_u, n_past_y, nu, ny)
y_hat = simulate(model, past_u, past_y, u)"""
