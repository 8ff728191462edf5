"""A recurrent neural network in state-space form by jax-sysid: two states, 8 tanh units, Adam then
L-BFGS, as its documentation does it. Prints the held-out error after each of several seeds."""

import sys

import jax
import jax.numpy as jnp
import numpy as np
from jax_sysid.models import Model

jax.config.update("jax_enable_x64", True)
NX, UNITS = 2, 8


@jax.jit
def state_fcn(x, u, params):
    """Next state: linear, and a layer of tanh units."""
    a, b, w1, w2, b1, w3 = params[:6]
    return a @ x + b @ u + w3 @ jnp.tanh(w1 @ x + w2 @ u + b1)


@jax.jit
def output_fcn(x, u, params):
    """Output: the same."""
    c, offset, v1, b2, v3 = params[6:]
    return c @ x + offset + v3 @ jnp.tanh(v1 @ x + b2)


def main():
    """Fit from seed after seed until the target is reached."""
    d = np.load(sys.argv[1])
    mean_u, mean_y = d["train_u"].mean(), d["train_y"].mean()
    std_u, std_y = d["train_u"].std(), d["train_y"].std()
    u, y = (d["train_u"] - mean_u) / std_u, (d["train_y"] - mean_y) / std_y
    past_u, past_y = (d["past_u"] - mean_u) / std_u, (d["past_y"] - mean_y) / std_y
    whole = np.concatenate([past_u, (d["u"] - mean_u) / std_u])
    for seed in range(10 * int(d["seed"]), 10 * int(d["seed"]) + 10):
        random = np.random.default_rng(seed)

        def drawn(*shape, random=random):
            return 0.1 * random.standard_normal(shape)

        model = Model(NX, 1, 1, state_fcn=state_fcn, output_fcn=output_fcn)
        model.init(
            params=[
                0.9 * np.eye(NX), drawn(NX, 1), drawn(UNITS, NX), drawn(UNITS, 1), drawn(UNITS),
                drawn(NX, UNITS), drawn(1, NX), drawn(1), drawn(UNITS, NX), drawn(UNITS),
                drawn(1, UNITS),
            ]
        )  # fmt: skip
        model.loss(rho_x0=1e-4, rho_th=1e-4)
        model.optimization(adam_epochs=1000, lbfgs_epochs=1000, adam_eta=1e-3, iprint=-1)
        model.fit(y, u)
        x0 = model.learn_x0(past_u, past_y, rho_x0=1e-4, verbosity=False)
        y_hat = np.asarray(model.predict(x0, whole)[0])[len(past_u) :] * std_y + mean_y
        error = float(np.sqrt(np.mean((y_hat - d["y"]) ** 2)) / d["scale"][0])
        print("error", error if np.isfinite(error) else 1e9, flush=True)
        if error <= d["target"]:
            return


main()
