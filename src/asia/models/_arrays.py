"""Array functions for NumPy and JAX. A model's step is written once; training runs it in JAX and
simulation in NumPy, which needs no compiler and no import of JAX.

    xp = namespace(x)
    return xp.tanh(x @ w) * sigmoid(x)
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from types import ModuleType
from typing import Any, NamedTuple, TypeAlias, cast

import numpy as np
from numpy.typing import DTypeLike

from asia.lowering.program import FUNCTION

AnyArray: TypeAlias = Any
"""NumPy array in simulation, JAX array in training."""

_PLAIN = (np.ndarray, np.generic, float, int)


def namespace(*arrays: AnyArray) -> ModuleType:
    """Return numpy where all arguments are NumPy arrays or numbers, else jax.numpy."""
    for array in arrays:
        if not isinstance(array, _PLAIN):
            import jax.numpy

            return jax.numpy
    return np


def sigmoid(x: AnyArray) -> AnyArray:
    """Compute 1 / (1 + exp(-x)) without overflow."""
    if namespace(x) is not np:
        import jax

        return jax.nn.sigmoid(x)  # its derivative is cheaper than that of the line below
    return 0.5 * np.tanh(0.5 * x) + 0.5


def softplus(x: AnyArray) -> AnyArray:
    """Compute log(1 + exp(x))."""
    return namespace(x).logaddexp(x, 0.0)


def relu(x: AnyArray) -> AnyArray:
    """Compute max(x, 0), with derivative 0 at 0."""
    return namespace(x).where(x > 0, x, 0)


def gelu(x: AnyArray) -> AnyArray:
    """Gaussian error linear unit in its tanh form: Hendrycks and Gimpel, arXiv 1606.08415, 2016."""
    return 0.5 * x * (1.0 + namespace(x).tanh(0.7978845608028654 * (x + 0.044715 * x * x * x)))


def softmax(x: AnyArray) -> AnyArray:
    """Compute the softmax over the last axis."""
    if namespace(x) is not np:
        import jax

        # The derivative in JAX omits that of the maximum, which cancels.
        return jax.nn.softmax(x, axis=-1)
    raised = x - x.max(axis=-1, keepdims=True)
    np.exp(raised, out=raised)
    raised /= raised.sum(axis=-1, keepdims=True)
    return raised


def bounded(x: AnyArray, low: AnyArray, high: AnyArray) -> AnyArray:
    """Clip x to low and high."""
    xp = namespace(x)
    return xp.minimum(xp.maximum(x, low), high)


def split(x: AnyArray, parts: int) -> list[AnyArray]:
    """Split the last axis into equal parts; in NumPy without the cost of `numpy.split`."""
    xp = namespace(x)
    if xp is not np:
        return xp.split(x, parts, axis=-1)
    size = x.shape[-1] // parts
    return [x[..., i * size : (i + 1) * size] for i in range(parts)]


def gates(x: AnyArray, parts: int) -> list[AnyArray]:
    """Split the last axis into equal parts: the sigmoids of all but the last, and the last
    unchanged."""
    if namespace(x) is np:
        wide = x.shape[-1] // parts * (parts - 1)
        return [*split(sigmoid(x[..., :wide]), parts - 1), x[..., wide:]]
    # One operation a part: the gradient of a joint operation takes 1.5 times as long.
    *found, last = split(x, parts)
    return [*(sigmoid(part) for part in found), last]


def rows(values: Sequence[AnyArray], like: AnyArray) -> AnyArray:
    """Stack values that broadcast to like[0]: (len(values), *like.shape[1:]) in its dtype."""
    shape = (len(values), *like.shape[1:])
    if isinstance(like, np.ndarray):
        # Much faster than np.stack where the rows are short.
        filled = np.empty(shape, like.dtype)
        for i, value in enumerate(values):
            filled[i] = value
        return filled
    import jax.numpy as jnp

    if not values:
        return jnp.zeros(shape, like.dtype)
    return jnp.stack([jnp.broadcast_to(jnp.asarray(v, like.dtype), shape[1:]) for v in values])


def repeated(step: Callable[[AnyArray], AnyArray], times: int, state: AnyArray) -> AnyArray:
    """Apply a step so many times."""
    if times > 1 and not isinstance(state, np.ndarray):
        import jax

        return jax.lax.scan(lambda state, _: (step(state), None), state, length=times)[0]
    for _ in range(times):
        state = step(state)
    return state


def folded(step: Callable[[Any, AnyArray], Any], state: Any, rows: AnyArray) -> Any:
    """Apply `step(state, rows[k])` -> state to all rows."""
    if len(rows) > 1 and namespace(rows) is not np:
        import jax

        return jax.lax.scan(lambda state, row: (step(state, row), None), state, rows)[0]
    for row in rows:
        state = step(state, row)
    return state


def scan(
    step: Callable[[Any, AnyArray], tuple[Any, AnyArray]], state: Any, inputs: AnyArray
) -> tuple[Any, AnyArray]:
    """Apply `step(state, inputs[k])` -> state, result to all inputs.

    Returns:
        The last state, and the results (T, ...): an array, or a tuple of arrays.
    """
    if namespace(inputs) is not np:
        import jax

        return jax.lax.scan(step, state, inputs)
    results: list[AnyArray] = []
    for row in np.ascontiguousarray(inputs):
        state, result = step(state, row)
        results.append(result)
    if not results:  # no samples: arrays of the shape that a sample would give
        results.append(step(state, np.zeros(inputs.shape[1:], inputs.dtype))[1])
        kept = slice(0)
    else:
        kept = slice(None)
    if isinstance(results[0], tuple):
        return state, tuple(np.stack(each)[kept] for each in zip(*results, strict=True))
    return state, np.stack(results)[kept]


def function(
    xp: ModuleType, names: str, compute: Callable[..., AnyArray]
) -> Callable[..., AnyArray]:
    """Make a function that printed code keeps as one of its own. names: its name, then those of its
    arguments."""
    if xp is np:
        return compute
    import jax

    def called(*arguments: AnyArray) -> AnyArray:
        # Another function for each trace, as it may read values of the trace around it.
        def own(*inner: AnyArray) -> AnyArray:
            return compute(*inner)

        own.__name__ = FUNCTION + names
        return jax.jit(own)(*arguments)

    return called


def labelled(value: AnyArray, name: str) -> AnyArray:
    """Name a JAX array in printed code."""
    from jax.ad_checkpoint import checkpoint_name

    return checkpoint_name(value, name)


def tree_size(tree: Any) -> int:
    """Count the numbers in a tree of mappings, sequences and arrays."""
    if isinstance(tree, Mapping):
        tree = list(cast("Mapping[str, Any]", tree).values())
    if isinstance(tree, Sequence):
        return sum(tree_size(branch) for branch in cast("Sequence[Any]", tree))
    return int(np.size(tree))


class Packing(NamedTuple):
    """Layout of a tree of arrays in one vector; hashable.

    An update is then one operation, whatever the number of arrays, and a program compiles faster.
    """

    treedef: Any
    """Names and nesting of the tree."""
    shapes: tuple[tuple[int, ...], ...]
    """Shapes of the leaves."""

    @classmethod
    def of(cls, tree: Any) -> Packing:
        """Layout of a tree of arrays."""
        import jax

        leaves, treedef = jax.tree.flatten(tree)
        return cls(treedef, tuple(np.shape(leaf) for leaf in leaves))

    def unpack(self, vector: AnyArray) -> Any:
        """Unpack a vector to the tree, of NumPy or JAX arrays."""
        import jax

        ends = np.cumsum([int(np.prod(shape)) for shape in self.shapes]).tolist()
        parts = [vector[a:b] for a, b in pairwise([0, *ends])]
        leaves = [part.reshape(shape) for part, shape in zip(parts, self.shapes, strict=True)]
        return jax.tree.unflatten(self.treedef, leaves)


def packed(tree: Any, dtype: DTypeLike) -> Any:
    """Pack the tree into one NumPy vector."""
    import jax

    parts = [np.zeros(0), *(np.ravel(leaf) for leaf in jax.tree.leaves(tree))]
    return np.concatenate(parts, dtype=dtype, casting="unsafe")
