"""Fits in these tests take milliseconds, and their compilation seconds."""

from collections.abc import Iterator

import jax
import pytest


@pytest.fixture(autouse=True, scope="module")
def quick_compilation(request: pytest.FixtureRequest) -> Iterator[None]:
    """Programs are compiled without most optimisations, but where fits take many steps."""
    before = jax.config.read("jax_disable_most_optimizations")
    quick = request.path.parent.name not in ("one_step", "models")
    jax.config.update("jax_disable_most_optimizations", quick or before)
    yield
    jax.config.update("jax_disable_most_optimizations", before)
