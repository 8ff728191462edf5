"""A tree of arrays as one vector: an update is then one operation, whatever the number of arrays,
and a program compiles the faster."""

from __future__ import annotations

from itertools import pairwise
from typing import Any, NamedTuple

import jax
import numpy as np
from numpy.typing import DTypeLike

from asia.models._arrays import AnyArray


class Packing(NamedTuple):
    """How a tree lies in a vector; hashable."""

    treedef: Any
    """Names and nesting."""
    shapes: tuple[tuple[int, ...], ...]
    """Of the leaves."""

    @classmethod
    def of(cls, tree: Any) -> Packing:
        """That of a tree of arrays."""
        leaves, treedef = jax.tree.flatten(tree)
        return cls(treedef, tuple(np.shape(leaf) for leaf in leaves))

    def unpack(self, vector: AnyArray) -> Any:
        """The tree that lies in it, of NumPy or JAX arrays."""
        ends = np.cumsum([int(np.prod(shape)) for shape in self.shapes]).tolist()
        parts = [vector[a:b] for a, b in pairwise([0, *ends])]
        leaves = [part.reshape(shape) for part, shape in zip(parts, self.shapes, strict=True)]
        return jax.tree.unflatten(self.treedef, leaves)


def packed(tree: Any, dtype: DTypeLike) -> Any:
    """The tree as one NumPy vector."""
    parts = [np.zeros(0), *(np.ravel(leaf) for leaf in jax.tree.leaves(tree))]
    return np.concatenate(parts, dtype=dtype, casting="unsafe")
