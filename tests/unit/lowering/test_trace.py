"""Lowering of JAX functions to a model."""

import gc
from collections.abc import Iterator
from weakref import ref

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from asia.lowering.derivatives import derivatives
from asia.lowering.evaluation import evaluate, simulate
from asia.lowering.program import Builder, LoweredModel, names_of
from asia.lowering.trace import lowered, lowered_bytes
from asia.lowering.wire import unpack
from asia.models._arrays import function, labelled


@pytest.fixture(autouse=True)
def double() -> Iterator[None]:
    before = jax.config.jax_enable_x64
    jax.config.update("jax_enable_x64", True)
    yield
    jax.config.update("jax_enable_x64", before)


class Model:
    """One case; the step is that of its only row."""

    def __init__(self, step) -> None:
        self._step = step

    def initial(self, past_u, past_y, u):
        return past_y[:, -1]

    def step(self, state, u):
        after, y = self._step(state[0], u[0])
        return jax.tree.map(lambda leaf: leaf[None], after), y[None]


def test_outputs_belong_to_the_caller_and_programs_are_freed() -> None:
    build = Builder(((2,),))
    fixed = build.add("add", (build.constant([1.0, 2.0]), build.constant([3.0, 4.0])))
    program = build.program([fixed, build.add("mul", (0, fixed))])
    first, _ = evaluate(program, [np.ones(2)])
    first[:] = 0.0
    again, product = evaluate(program, [np.full(2, 2.0)])
    assert again.tolist() == [4.0, 6.0]
    assert product.tolist() == [8.0, 12.0]
    gone = ref(program)
    del program
    gc.collect()
    assert gone() is None


def of(step) -> LoweredModel:
    return lowered(Model(step), 1, 2, 2, 2)


W = np.array([[0.3, -0.2], [0.1, 0.5]])


def damped(x, u):
    """A function that printed code keeps, called twice, with a label and a number of the model."""
    rate = jnp.asarray(0.5) * 0.6
    inner = function(jnp, "damp states", lambda v: labelled(v * rate, "slow state"))
    return inner(inner(x)) + u, inner(u)


STEPS = {
    "function": damped,
    "tanh": lambda x, u: (jnp.tanh(x @ W + u), x),
    "where": lambda x, u: (jnp.where(x > u, x, 0.5 * u), jnp.maximum(x, u)),
    "clip": lambda x, u: (jnp.clip(x + u, -1.0, 1.0), jnp.abs(x) ** 3 + u),
    "sort out": lambda x, u: (x[::-1] * 0.9 + u, jnp.stack([x[1], u[0]])),
    "softplus": lambda x, u: (jax.nn.softplus(0.2 * x), jax.nn.softmax(x + u)),
    "norm": lambda x, u: (x / jnp.sqrt(1 + (x * x).sum()) + u, jnp.cumprod(jnp.ones(2)) * x.mean()),
    "einsum": lambda x, u: (jnp.einsum("ij,j,k->i", W, x, u[:1]), jnp.outer(x, u).sum(axis=0)),
    "sigmoid": lambda x, u: (jax.nn.sigmoid(x) - u, jnp.exp(-x) + jnp.log1p(u * u)),
    "loop": lambda x, u: (jax.lax.fori_loop(0, 3, lambda i, v: 0.5 * v + u + 0.1 * i, x), x),
    "scan": lambda x, u: jax.lax.scan(lambda c, v: (0.9 * c + v, c.sum()), x, W * u),
    "cond": lambda x, u: (jax.lax.cond(x[0] > 0, lambda a: a * 0.5, lambda a: -a, x), x + u),
    "pad": lambda x, u: (jnp.pad(x, (1, 0))[:2] + u, jnp.linalg.norm(x + 1.0) * jnp.ones(2)),
    "power": lambda x, u: (x**-2.0 + u, jnp.power(jnp.abs(x) + 1, 1.5)),
    "angle": lambda x, u: (jnp.arctan2(x, u), jnp.sign(x) * jnp.floor(u)),
    "finite": lambda x, u: (jnp.where(jnp.isfinite(x / u), x, u), jnp.logical_or(x > 0, u < 0) * x),
}


@pytest.mark.parametrize("name", STEPS)
def test_a_lowered_step_computes_what_the_function_does(name: str) -> None:
    step, model = STEPS[name], of(STEPS[name])
    rng = np.random.default_rng(0)
    past_y, u = rng.uniform(-1, 1, (2, 2)), rng.uniform(-1, 1, (4, 2))
    x, expected = jnp.asarray(past_y[-1]), []
    for row in u:
        x, y = step(x, jnp.asarray(row))
        expected.append(np.asarray(y))
    found = simulate(model, np.zeros((1, 2)), past_y, u)
    np.testing.assert_allclose(found, expected, rtol=1e-13, atol=1e-14)
    assert not model.single


FURTHER = {
    "batched": lambda x, u: (
        (jnp.stack([W * x, W + u[0]]) @ jnp.stack([W, W * u]))[1, 0], (x @ (W * u)) @ W
    ),
    "greatest": lambda x, u: (jnp.stack([x * u, x + u]).max(axis=0), jnp.outer(x, u).min(axis=1)),
    "product": lambda x, u: (jnp.outer(x, u).prod(axis=0), jnp.stack([x, u * x, u]).prod(axis=0)),
    "nested": lambda x, u: (
        jax.lax.fori_loop(
            0, 3, lambda i, v: jax.lax.fori_loop(0, 2, lambda j, w: jnp.tanh(w * u), v) + x, u
        ), x,
    ),
    "rows": lambda x, u: jax.lax.scan(
        lambda c, v: (jnp.sin(c) * v[0] + 0.1, (c * v, v)), x, W * x + u
    ),
    "transposed": lambda x, u: ((jnp.outer(x, u).T @ x)[::-1], jnp.outer(x, u)[:, 1]),
}  # fmt: skip


@pytest.mark.parametrize("name", [*STEPS, *FURTHER])
def test_the_program_of_the_derivatives_agrees_with_jax(name: str) -> None:
    step = (STEPS | FURTHER)[name]
    if name == "rows":
        step = lambda x, u, inner=step: (inner(x, u)[0], inner(x, u)[1][0].sum(axis=0))  # noqa: E731
    x, u = np.array([0.31, -0.52]), np.array([0.7, 0.4])

    def outputs(x, u):
        after, y = step(x, u)
        return jnp.concatenate([jnp.ravel(y), after])

    expected = np.concatenate(jax.jacfwd(outputs, (0, 1))(x, u), axis=1)
    values, slopes = derivatives(of(step).step, [x, u])
    np.testing.assert_allclose(values, outputs(x, u), rtol=1e-12)
    np.testing.assert_allclose(slopes, expected, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize(
    ("step", "words"),
    [
        (lambda x, u: (jnp.sort(x), u), "sort"),
        (lambda x, u: (jnp.fft.fft(x).real, u), "complex"),
        (lambda x, u: (x + u[jnp.argmax(x)], u), "argmax"),
        (lambda x, u: ((x, x), u), "another structure"),
        (lambda x, u: (jnp.concatenate([x, u]), u), "other shapes"),
        (lambda x, u: (x if x[0] > 0 else u, u), "TracerBoolConversionError"),
        (lambda x, u: (jax.lax.while_loop(lambda v: v.sum() > 1, lambda v: v / 2, x), u), "while"),
    ],
)
def test_what_cannot_be_lowered_is_named(step, words: str) -> None:
    found = unpack(lowered_bytes(Model(step), 1, 2, 2, 2))
    assert isinstance(found, str)
    assert words in found


def test_functions_and_labels_keep_their_names_until_a_reader_needs_none() -> None:
    step = of(damped).step
    calls = [node for node in step.nodes if node.op == "call"]
    assert [names_of(node.attrs) for node in calls] == [["damp", "states"]] * 3
    labels = [node for node in calls[0].body.nodes if node.op == "label"]
    assert [names_of(node.attrs) for node in labels] == [["slow_state"]]
    assert not {"call", "label"} & {node.op for node in step.plain.nodes}
    assert step.plain.plain is step.plain


def test_a_model_without_steps_is_told_what_to_add() -> None:
    found = unpack(lowered_bytes(object(), 1, 1, 1, 1))
    assert "initial() and step()" in str(found)


def test_a_state_without_a_batch_is_named() -> None:
    class Unbatched(Model):
        def initial(self, past_u, past_y, u):
            return past_y[0]

    found = unpack(lowered_bytes(Unbatched(lambda x, u: (x, u)), 1, 2, 2, 2))
    assert "batch comes first" in str(found)


def test_a_model_that_computes_in_single_precision_is_marked() -> None:
    model = of(lambda x, u: (x, (x.astype(np.float32) * np.float32(0.1)).astype(np.float64) + u))
    assert model.single
